"""Prediction of 8-bit planes, encoding side: pixels become what an interpolation from coarser ones misses.

A plane is predicted from coarse to fine. Each level halves the grid: pixels at the centre of four known
ones first, then those between two known ones and two centres. The prediction is the mean of the middle two
of the four neighbours. A sensor's noise is what costs bytes, and an interpolation carries less of it than
the usual prediction from left and above. No pixel depends on the one before it and all sums are modulo 256,
so that both sides run in vector units, a byte a pixel. `kernels.py` is the decoding side.
"""

import cv2
import numpy as np

from rig_protocol.frames import ImageU8

LEVELS = 3
"""Real images of 640×480 pixels gain less than a thousandth from a fourth."""

BLOCK = 1 << LEVELS
"""Planes are whole multiples of this many pixels; images are padded to it."""

MIDDLE = 128
"""What a difference of zero is stored as, so that small ones of either sign lie side by side."""


def padded_shape(height: int, width: int, block: int) -> tuple[int, int]:
    """Height and width rounded up to whole blocks."""
    return -(-height // block) * block, -(-width // block) * block


def pad(image: ImageU8, block: int) -> ImageU8:
    """The image with its last row and column repeated up to whole blocks, in one piece."""
    height, width = image.shape[:2]
    rows, columns = padded_shape(height, width, block)
    if (rows, columns) == (height, width):
        return np.ascontiguousarray(image)
    edges = (0, rows - height, 0, columns - width)
    return np.asarray(cv2.copyMakeBorder(image, *edges, cv2.BORDER_REPLICATE), np.uint8)


def quarters(planes: ImageU8) -> tuple[ImageU8, ImageU8, ImageU8, ImageU8]:
    """Of planes (N, H, W), the pixels at (even row, even column), (even, odd), (odd, even) and (odd, odd)."""
    count, height, width = planes.shape
    halves = cv2.split(planes.reshape(count * height, width // 2, 2))
    left, right = (np.asarray(half, np.uint8).reshape(count, height, width // 2) for half in halves)
    return left[:, 0::2], right[:, 0::2], left[:, 1::2], right[:, 1::2]


def residuals(planes: ImageU8) -> ImageU8:
    """The residuals (N, H·W) of planes (N, H, W): the coarsest grid first, then each level's three steps."""
    missed = np.empty((len(planes), planes[0].size), np.uint8)
    for _ in range(LEVELS):
        corners, between_columns, between_rows, centres = quarters(planes)
        size = corners[0].size
        steps = missed[:, size : 4 * size].reshape(len(planes), 3, *corners.shape[1:])
        at_centres, at_columns, at_rows = predictions(corners, centres)
        np.subtract(centres, at_centres, out=steps[:, 0])
        np.subtract(between_columns, at_columns, out=steps[:, 1])
        np.subtract(between_rows, at_rows, out=steps[:, 2])
        planes = corners
    coarsest = planes.reshape(len(planes), -1)
    missed[:, :1] = coarsest[:, :1]
    np.subtract(coarsest[:, 1:], coarsest[:, :-1], out=missed[:, 1 : coarsest.shape[1]])
    return missed


def predictions(corners: ImageU8, centres: ImageU8) -> tuple[ImageU8, ImageU8, ImageU8]:
    """Predictions of the centres, of the pixels to the right of the corners, and of those below them.

    Each is of four neighbours in two pairs, and most pairs serve two of the predictions.
    """
    known = np.pad(corners, ((0, 0), (0, 1), (0, 1)), mode="edge")
    around = np.pad(centres, ((0, 0), (1, 0), (1, 0)), mode="edge")
    low, high = _sorted(known[:, :, :-1], known[:, :, 1:])
    at_centres = _middle(low[:, :-1], high[:, :-1], low[:, 1:], high[:, 1:])
    beside = _sorted(around[:, :-1, 1:], centres)
    at_columns = _middle(low[:, :-1], high[:, :-1], *beside)
    above = _sorted(corners, known[:, 1:, :-1])
    at_rows = _middle(*above, *_sorted(around[:, 1:, :-1], centres))
    return at_centres, at_columns, at_rows


def _sorted(a: ImageU8, b: ImageU8) -> tuple[ImageU8, ImageU8]:
    return np.minimum(a, b), np.maximum(a, b)


def _middle(low_a: ImageU8, high_a: ImageU8, low_b: ImageU8, high_b: ImageU8) -> ImageU8:
    """Mean, rounded up, of the middle two of two sorted pairs; it takes no more than eight bits."""
    mean, other = np.maximum(low_a, low_b), np.minimum(high_a, high_b)
    half = mean ^ other
    half >>= 1
    mean |= other
    mean -= half
    return mean
