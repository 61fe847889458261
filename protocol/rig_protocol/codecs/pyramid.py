"""Prediction of 8-bit planes, encoding side: pixels become what an interpolation from coarser ones misses.

A plane is predicted from coarse to fine. Each level halves the grid: pixels at the centre of four known
ones first, then those between two known ones and two centres. The prediction is the mean of the middle two
of the four neighbours. A sensor's noise is what costs bytes, and an interpolation carries less of it than
the usual prediction from left and above. No pixel depends on the one before it and all sums are modulo 256,
so that both sides run in vector units, a byte a pixel. `kernels.py` is the decoding side.
"""

from typing import Literal

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

    Each is of four neighbours in two pairs, and most pairs serve two of the predictions. The sums run over
    framed grids as one line: `pitch` further on is the next row, and what joins two rows lies in the frame.
    """
    count, height, width = corners.shape
    pitch = width + 1
    corner, centre = _framed(corners, 0), _framed(centres, 1)
    low, high = _sorted(corner[:-1], corner[1:])
    beside = low[:-pitch], high[:-pitch]
    at_centres = _middle(*beside, low[pitch:], high[pitch:])
    at_columns = _middle(*beside, *_sorted(centre[1:-pitch], centre[pitch + 1 :]))
    below = _sorted(corner[: -pitch - 1], corner[pitch:-1])
    at_rows = _middle(*below, *_sorted(centre[pitch:-1], centre[pitch + 1 :]))
    lines = (at_centres, at_columns, at_rows)
    grids = [line.reshape(count, height + 1, pitch)[:, :height, :width] for line in lines]
    return grids[0], grids[1], grids[2]


def _framed(planes: ImageU8, start: Literal[0, 1]) -> ImageU8:
    """Planes as one line, each framed by a repeated row and column: after it, or before it if `start` is 1.

    The line is a row and a pixel longer than that, so that the last pixel has its neighbours.
    """
    count, height, width = planes.shape
    pitch, size = width + 1, count * (height + 1) * (width + 1)
    line = np.empty(size + pitch + 1, np.uint8)
    line[size:] = 0
    framed = line[:size].reshape(count, height + 1, pitch)
    framed[:, start : start + height, start : start + width] = planes
    edge, inner = (0, 1) if start else (-1, -2)
    framed[:, :, edge] = framed[:, :, inner]
    framed[:, edge] = framed[:, inner]
    return line


def _sorted(a: ImageU8, b: ImageU8) -> tuple[ImageU8, ImageU8]:
    return np.minimum(a, b), np.maximum(a, b)


def _middle(low_a: ImageU8, high_a: ImageU8, low_b: ImageU8, high_b: ImageU8) -> ImageU8:
    """Mean, rounded up, of the middle two of two sorted pairs; it takes no more than eight bits."""
    mean, other = np.maximum(low_a, low_b), np.minimum(high_a, high_b)
    half = np.bitwise_xor(mean, other)
    half >>= 1
    mean |= other
    mean -= half
    return mean
