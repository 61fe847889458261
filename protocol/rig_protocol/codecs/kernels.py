"""Decoding loops compiled to machine code, on the PC only: the codecs' one module that needs Numba.

Every loop runs without the interpreter's lock and stays within its arrays whatever the bytes say. The loops
over a row are written so that the compiler turns them into vector instructions: eight-bit sums of eight-bit
numbers, no element that waits for the one before. `pyramid.py` and `depth.py` are the encoding side and
explain the layout.
"""

import numpy as np
import numpy.typing as npt
from numba import int64, types, uint8, uint16, void

from rig_protocol.codecs.pyramid import LEVELS, MIDDLE
from rig_protocol.compiled import compiled, inlined

U8 = npt.NDArray[np.uint8]
U16 = npt.NDArray[np.uint16]
U64 = npt.NDArray[np.uint64]

# Constants are compiled in, and the cache looks at this file alone: touch it when `pyramid` changes.
_LEVELS = LEVELS
_MIDDLE = np.uint8(MIDDLE)
_ZERO, _ONE = np.uint8(0), np.uint8(1)
_BAND = 8
"""Rows whose measured pixels share the bytes of a depth image's mask."""

_DE_BRUIJN = np.uint64(0x03F7_9D71_B4CB_0A89)
"""Its products with the 64 powers of two differ in their upper six bits, each of which so names a bit."""
_PIXEL_OF_BIT = np.zeros(64, np.uint8)
for _bit in range(64):
    _PIXEL_OF_BIT[(int(_DE_BRUIJN) << _bit & 2**64 - 1) >> 58] = _bit // 2

_STREAM = types.Array(uint8, 1, "C", readonly=True)
_STREAM_IMAGE = types.Array(uint8, 2, "C", readonly=True)
_COUNTS = types.Tuple((int64, int64))  # type: ignore[no-untyped-call]  # Numba leaves it so


@inlined
def _restore_row(a: U8, b: U8, c: U8, d: U8, residual: U8, offset: np.uint8, row: U8) -> None:
    """Pixels from their four neighbours: the mean of the middle two, rounded up, plus what it missed."""
    for x in range(row.size):
        low = max(min(a[x], b[x]), min(c[x], d[x]))
        high = min(max(a[x], b[x]), max(c[x], d[x]))
        mean = np.uint8((low | high) - ((low ^ high) >> _ONE))  # the sum would need a ninth bit
        row[x] = np.uint8(mean + residual[x] + offset)


@inlined
def _interleave(even: U8, odd: U8, row: U8) -> None:
    for x in range(odd.size):
        row[2 * x] = even[x]
        row[2 * x + 1] = odd[x]


@inlined
def _copy_row(source: U8, row: U8) -> None:
    for x in range(row.size):
        row[x] = source[x]


@inlined
def _repeat_edges(plane: U8) -> None:
    """Fill the last row and column with those before them."""
    height, width = plane.shape[0] - 1, plane.shape[1] - 1
    for y in range(height):
        plane[y, width] = plane[y, width - 1]
    _copy_row(plane[height - 1], plane[height])


@inlined
def _refine(corners: U8, at_centres: U8, at_columns: U8, at_rows: U8, offset: np.uint8, finer: U8) -> None:
    """Fill a grid from every second pixel (H + 1, W + 1; edges repeated) and the residuals of the others.

    `offset` is added to the pixels between two corners.
    """
    height, width = corners.shape[0] - 1, corners.shape[1] - 1
    above, centres = np.empty(width + 1, np.uint8), np.empty(width + 1, np.uint8)  # the first is repeated
    between = np.empty(width, np.uint8)
    for y in range(height):
        left, right = corners[y, :-1], corners[y, 1:]
        under_left, under_right = corners[y + 1, :-1], corners[y + 1, 1:]
        _restore_row(left, right, under_left, under_right, at_centres[y], _ZERO, centres[1:])
        centres[0] = centres[1]
        if y == 0:
            _copy_row(centres, above)
        _restore_row(left, right, centres[1:], above[1:], at_columns[y], offset, between)
        _interleave(left, between, finer[2 * y])
        _restore_row(left, under_left, centres[1:], centres[:-1], at_rows[y], offset, between)
        _interleave(between, centres[1:], finer[2 * y + 1])
        above, centres = centres, above


@inlined
def _restore_coarsest(residuals: U8, height: int, width: int) -> U8:
    """Each pixel from the one before."""
    plane = np.empty((height + 1, width + 1), np.uint8)
    value = _ZERO
    for y in range(height):
        for x in range(width):
            value = np.uint8(value + residuals[y * width + x])
            plane[y, x] = value
    _repeat_edges(plane)
    return plane


@inlined
def _restore_plane(residuals: U8, height: int, width: int) -> U8:
    """A plane of whole blocks, with its last row and column repeated (H + 1, W + 1)."""
    height, width = height >> _LEVELS, width >> _LEVELS
    plane = _restore_coarsest(residuals, height, width)
    for _ in range(_LEVELS):
        size = height * width
        steps = residuals[size : 4 * size].reshape(3, height, width)
        height, width = 2 * height, 2 * width
        finer = np.empty((height + 1, width + 1), np.uint8)
        _refine(plane, steps[0], steps[1], steps[2], _ZERO, finer)
        _repeat_edges(finer)
        plane = finer
    return plane


@compiled(void(_STREAM_IMAGE, uint8[:, :, ::1]))
def restore_planes(residuals: U8, planes: U8) -> None:
    """Fill planes (N, H, W) of whole blocks from their residuals (N, H·W)."""
    for index in range(len(planes)):
        plane = _restore_plane(residuals[index], planes.shape[1], planes.shape[2])
        for y in range(planes.shape[1]):
            _copy_row(plane[y], planes[index, y])


@compiled(void(_STREAM, uint8[:, ::1]))
def restore_mosaic(residuals: U8, mosaic: U8) -> None:
    """Fill a mosaic of whole blocks (H, W) from its residuals (H·W).

    It is one more level: green in even rows is the coarser plane, and what a prediction of green misses
    at red and at blue are planes themselves. Adding the 128 that they are stored with takes it away,
    modulo 256.
    """
    height, width = mosaic.shape[0] // 2, mosaic.shape[1] // 2
    size = height * width
    green = _restore_plane(residuals[:size], height, width)
    red = _restore_plane(residuals[size : 2 * size], height, width)
    blue = _restore_plane(residuals[2 * size : 3 * size], height, width)
    centres = residuals[3 * size :].reshape(height, width)
    _refine(green, centres, red, blue, _MIDDLE, mosaic)


@inlined
def _unpack_codes(codes: U8, steps: U64, escaped: U8) -> None:
    """Steps 0, −1, 1 of the codes 0, 1, 2, four 16-bit ones in a word; code 3 gives 0 and a set bit."""
    four = np.uint64(0x0001_0001_0001_0001)
    for x in range(codes.size):
        escaped[x] = codes[x] & (codes[x] >> _ONE) & np.uint8(0b01010101)
        word = np.uint64(codes[x])
        word = (word | (word << np.uint64(28))) & np.uint64(0x0000_000F_0000_000F)
        word = (word | (word << np.uint64(14))) & np.uint64(0x0003_0003_0003_0003)
        low, high = word & four, (word >> np.uint64(1)) & four
        minus_one = low & ~high
        steps[x] = (high & ~low) | ((minus_one << np.uint64(16)) - minus_one)


@inlined
def _unpack_escapes(escapes: U8) -> U16:
    """Steps of zigzag − 3 in low bytes, high bytes."""
    steps = np.empty(escapes.shape[1], np.uint16)
    for x in range(steps.size):
        zigzag = np.uint16(escapes[0, x] + 256 * escapes[1, x] + 3)
        steps[x] = np.uint16((zigzag >> 1) ^ -(zigzag & 1))
    return steps


@inlined
def _insert_escapes(escaped: U8, escapes: U16, used: int, steps: U16) -> int:
    """Put escaped steps in their places; returns how many escapes the surface has asked for.

    One step in thirty is escaped: most words of 32 pixels are zero.
    """
    words = escaped.view(np.uint64)
    for index in range(words.size):
        word = words[index]
        while word != np.uint64(0):
            lowest_bit = word & (~word + np.uint64(1))
            word ^= lowest_bit
            if used < escapes.size:
                steps[32 * index + _PIXEL_OF_BIT[(lowest_bit * _DE_BRUIJN) >> np.uint64(58)]] = escapes[used]
            used += 1
    return used


@inlined
def _add_row(steps: U16, mask: U8, bit: np.uint8, none: np.uint16, last: U16, row: U16) -> np.uint16:
    """Each column's next value where there is a measurement, and the largest; `last` are those before."""
    largest = np.uint16(0)
    for x in range(row.size):
        last[x] = np.uint16(last[x] + steps[x])
        row[x] = last[x] if mask[x] & bit else none
        largest = max(largest, row[x])
    return largest


@compiled(_COUNTS(_STREAM_IMAGE, _STREAM_IMAGE, _STREAM_IMAGE, uint16, uint16[:, ::1]))
def restore_surface(mask: U8, codes: U8, escapes: U8, none: np.uint16, surface: U16) -> tuple[int, int]:
    """Fill `surface` from its mask, 2-bit codes and escapes (low bytes, high bytes).

    Returns how many escapes the codes ask for, which the caller compares with how many there are, and the
    largest value.
    """
    height, width = surface.shape
    stride = codes.shape[1]
    words, escaped = np.zeros(_BAND * stride, np.uint64), np.zeros(_BAND * stride, np.uint8)
    steps = words.view(np.uint16)
    last = np.zeros(width, np.uint16)
    jumps = _unpack_escapes(escapes)
    used, largest = 0, np.uint16(0)
    for top in range(0, height, _BAND):
        rows = min(_BAND, height - top)
        if rows < _BAND:
            escaped.fill(0)
        band = codes[top : top + rows].reshape(rows * stride)
        _unpack_codes(band, words, escaped)
        used = _insert_escapes(escaped, jumps, used, steps)
        for y in range(rows):
            row_steps, bit = steps[4 * stride * y :], np.uint8(1 << y)
            in_row = _add_row(row_steps, mask[top // _BAND], bit, none, last, surface[top + y])
            largest = max(largest, in_row)
    return used, int(largest)
