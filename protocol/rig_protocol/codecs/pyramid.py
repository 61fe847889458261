"""Prediction of 8-bit images, encoding side: residuals of a pyramid, sorted by how sure the prediction is.

A plane is predicted from coarse to fine. Each step halves the grid: pixels at the centre of four known
ones first (`diagonal`), then those between two known rows and columns (`cross`). The prediction is the
mean of the middle two of the four neighbours. Their range is the context: four classes of residuals,
which an entropy coder packs tighter apart than together. A sensor's noise is what costs bytes, and an
interpolation carries less of it than the usual prediction from left and above. Nothing depends on the
pixel before, so that both sides run in vector units. `kernels.py` is the decoding side.
"""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
import numpy.typing as npt

from rig_protocol.frames import ImageU8

Plane = npt.NDArray[np.int16]

LEVELS = 4
BLOCK = 1 << LEVELS
"""Planes are whole multiples of this many pixels; images are padded to it."""

CONTEXT_LIMITS = (5, 11, 24)
"""Ranges of four neighbours at which the next context begins; sizes of real frames are flat around them."""

CONTEXTS = len(CONTEXT_LIMITS) + 1

Step = tuple[Plane, Plane]
"""Residuals of some pixels, and the range of the neighbours that predicted each."""


def padded_shape(height: int, width: int, block: int) -> tuple[int, int]:
    """Height and width rounded up to whole blocks."""
    return -(-height // block) * block, -(-width // block) * block


def pad(image: ImageU8, block: int) -> ImageU8:
    """The image with its last row and column repeated up to whole blocks."""
    height, width = image.shape[:2]
    rows, columns = padded_shape(height, width, block)
    if (rows, columns) == (height, width):
        return image
    edges = (0, rows - height, 0, columns - width)
    return np.asarray(cv2.copyMakeBorder(image, *edges, cv2.BORDER_REPLICATE), np.uint8)


def quarters(image: npt.NDArray[np.integer]) -> tuple[Plane, Plane, Plane, Plane]:
    """Pixels at (even row, even column), (even, odd), (odd, even) and (odd, odd)."""
    top, bottom = image[0::2], image[1::2]
    a, b, c, d = (rows[:, start::2].astype(np.int16) for rows in (top, bottom) for start in (0, 1))
    return a, b, c, d


def plane_steps(plane: Plane, levels: int = LEVELS) -> Iterator[Step]:
    """Residuals of a plane from coarse to fine."""
    if levels == 0:
        yield np.diff(plane.ravel(), prepend=plane.dtype.type(0)), np.full(plane.size, 255, np.int16)
        return
    corners, between_columns, between_rows, centres = quarters(plane)
    yield from plane_steps(corners, levels - 1)
    yield step(centres, diagonal(corners))
    yield step(between_columns, cross_columns(corners, centres))
    yield step(between_rows, cross_rows(corners, centres))


def step(pixels: Plane, predicted: Step) -> Step:
    """The residuals of pixels against (prediction, range)."""
    return pixels - predicted[0], predicted[1]


def diagonal(corners: Plane) -> Step:
    """Prediction and range for the pixels at the centre of four corners."""
    right = _left_shifted(corners)
    return _middle(corners, right, _up_shifted(corners), _up_shifted(right))


def cross_columns(corners: Plane, centres: Plane) -> Step:
    """Prediction and range for the pixels to the right of each corner."""
    above = np.concatenate([centres[:1], centres[:-1]])
    return _middle(corners, _left_shifted(corners), centres, above)


def cross_rows(corners: Plane, centres: Plane) -> Step:
    """Prediction and range for the pixels below each corner."""
    left = np.concatenate([centres[:, :1], centres[:, :-1]], axis=1)
    return _middle(corners, _up_shifted(corners), centres, left)


def sort_residuals(steps: Sequence[Step]) -> list[ImageU8]:
    """The residuals modulo 256, one array for each context."""
    residuals = np.concatenate([residual.astype(np.uint8).ravel() for residual, _ in steps])
    ranges = np.concatenate([spread.ravel() for _, spread in steps])
    streams, below = [], np.zeros(ranges.size, np.bool_)
    for limit in CONTEXT_LIMITS:
        inside = ranges < limit
        streams.append(np.compress(inside ^ below, residuals))
        below = inside
    return [*streams, np.compress(~below, residuals)]


def _left_shifted(plane: Plane) -> Plane:
    return np.concatenate([plane[:, 1:], plane[:, -1:]], axis=1)


def _up_shifted(plane: Plane) -> Plane:
    return np.concatenate([plane[1:], plane[-1:]])


def _middle(a: Plane, b: Plane, c: Plane, d: Plane) -> Step:
    """Mean of the middle two of four values, and the range of all."""
    low_ab, high_ab, low_cd, high_cd = np.minimum(a, b), np.maximum(a, b), np.minimum(c, d), np.maximum(c, d)
    mean = np.maximum(low_ab, low_cd)
    mean += np.minimum(high_ab, high_cd)
    mean += 1
    mean >>= 1
    return mean, np.maximum(high_ab, high_cd) - np.minimum(low_ab, low_cd)
