"""Decoding loops compiled to machine code, on the PC only: the one module of the protocol that needs Numba.

Every loop runs without the interpreter's lock and stays within its arrays whatever the bytes say;
the caller compares the cursors with the stated lengths afterwards. `pyramid.py` and `depth.py` are the
encoding side and explain the layout.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numba
import numpy as np
import numpy.typing as npt
from numba import int16, int64, types, uint8, uint16, void

from rig_protocol.codecs.pyramid import CONTEXT_LIMITS, LEVELS

P = ParamSpec("P")
R = TypeVar("R")

U8 = npt.NDArray[np.uint8]
U16 = npt.NDArray[np.uint16]
I16 = npt.NDArray[np.int16]
I64 = npt.NDArray[np.int64]
Rows = tuple[I16, I16, I16, I16]

# Constants are compiled in, and the cache looks at this file alone: touch it when `pyramid` changes.
_LIMIT_1, _LIMIT_2, _LIMIT_3 = CONTEXT_LIMITS
_CENTRES, _COLUMNS, _ROWS = range(3)
_ESCAPED = 0xFFFE

_STREAM = types.Array(uint8, 1, "C", readonly=True)
_STREAM_IMAGE = types.Array(uint8, 2, "C", readonly=True)
_I16_IMAGE = int16[:, ::1]


def _compiled(signature: object) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Compile now, from the cache where there is one, so that no frame waits for it."""

    def compile_function(function: Callable[P, R]) -> Callable[P, R]:
        try:
            compiled: Callable[P, R] = numba.njit(signature, nogil=True, cache=True)(function)
        except (RuntimeError, OSError):  # neither the installation nor the user's cache folder takes it
            compiled = numba.njit(signature, nogil=True)(function)
        return compiled

    return compile_function


def _inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Part of the compiled functions that call it."""
    inlined: Callable[P, R] = numba.njit(nogil=True)(function)
    return inlined


@_inlined
def _neighbour_rows(band: int, corners: I16, centres: I16, y: int) -> Rows:
    """The four rows around row y of the centres (0), right of the corners (1) or below them (2)."""
    if band == _CENTRES:
        return corners[y, :-1], corners[y, 1:], corners[y + 1, :-1], corners[y + 1, 1:]
    if band == _COLUMNS:
        return corners[y, :-1], corners[y, 1:], centres[y + 1, 1:], centres[y, 1:]
    return corners[y, :-1], corners[y + 1, :-1], centres[y + 1, 1:], centres[y + 1, :-1]


@_inlined
def _predict_row(rows: Rows, prediction: I16, context: U8) -> None:
    a, b, c, d = rows
    for x in range(a.size):
        low_ab, high_ab = min(a[x], b[x]), max(a[x], b[x])
        low_cd, high_cd = min(c[x], d[x]), max(c[x], d[x])
        prediction[x] = (max(low_ab, low_cd) + min(high_ab, high_cd) + 1) >> 1
        spread = max(high_ab, high_cd) - min(low_ab, low_cd)
        context[x] = (spread >= _LIMIT_1) + (spread >= _LIMIT_2) + (spread >= _LIMIT_3)


@_inlined
def _take_residuals(context: U8, symbols: U8, cursors: I64, residual: U8) -> None:
    """A row's residuals, each from the stream of its context; advances `cursors`.

    What the row takes from the four streams is counted in one register, 16 bits each: through memory
    every pixel would wait some cycles for the count of the one before.
    """
    last, sixteen, low = symbols.size - 1, np.uint64(16), np.uint64(0xFFFF)
    taken = np.uint64(0)
    for x in range(context.size):
        shift = np.uint64(context[x]) * sixteen
        cursor = cursors[context[x]] + np.int64((taken >> shift) & low)
        residual[x] = symbols[min(cursor, last)]
        taken += np.uint64(1) << shift
    for stream in range(cursors.size):
        cursors[stream] += np.int64((taken >> (np.uint64(stream) * sixteen)) & low)


@_inlined
def _add_residuals(prediction: I16, residual: U8, reference: I16) -> None:
    """Turn a row's predictions into its differences to `reference`; their sum with it is 0–255."""
    for x in range(residual.size):
        prediction[x] = ((prediction[x] + residual[x] + reference[x]) & 255) - reference[x]


@_inlined
def _frame_corners(plane: I16 | U8, stride: int, corners: I16) -> None:
    """Every stride-th pixel, with the last row and column repeated."""
    height, width = corners.shape[0] - 1, corners.shape[1] - 1
    for y in range(height):
        for x in range(width):
            corners[y, x] = plane[stride * y, stride * x]
        corners[y, width] = corners[y, width - 1]
    for x in range(width + 1):
        corners[height, x] = corners[height - 1, x]


@_inlined
def _frame_centres(row: I16, y: int, centres: I16) -> None:
    """Put a row of centres in its place, with the first row and column repeated."""
    for x in range(row.size):
        centres[y + 1, x + 1] = row[x]
    centres[y + 1, 0] = row[0]
    if y == 0:
        for x in range(row.size + 1):
            centres[0, x] = centres[1, x]


@_inlined
def _restore_coarsest(plane: I16, stride: int, reference: I16, symbols: U8, cursors: I64) -> None:
    """Each pixel from the one before; the residuals are in the last context."""
    last = symbols.size - 1
    previous = 0
    for y in range(0, plane.shape[0], stride):
        for x in range(0, plane.shape[1], stride):
            value = (previous + symbols[min(cursors[-1], last)] + reference[y, x]) & 255
            cursors[-1] += 1
            previous = value - reference[y, x]
            plane[y, x] = previous


@_compiled(void(_I16_IMAGE, _STREAM, int64[::1], uint8[:, :]))
def restore_plane(reference: I16, symbols: U8, cursors: I64, pixels: U8) -> None:
    """Fill `pixels`, coded as differences to `reference`, of whole blocks; advances `cursors`."""
    stride = 1 << LEVELS
    rows, columns = reference.shape
    plane = np.empty((rows, columns), np.int16)
    _restore_coarsest(plane, stride, reference, symbols, cursors)
    while stride > 1:
        height, width, half = rows // stride, columns // stride, stride // 2
        corners = np.empty((height + 1, width + 1), np.int16)
        centres = np.empty((height + 1, width + 1), np.int16)
        row, under = np.empty(width, np.int16), np.empty(width, np.int16)
        context, residual = np.empty(width, np.uint8), np.empty(width, np.uint8)
        _frame_corners(plane, stride, corners)
        for band in range(3):
            down = 0 if band == _COLUMNS else half
            right = 0 if band == _ROWS else half
            for y in range(height):
                for x in range(width):
                    under[x] = reference[stride * y + down, stride * x + right]
                _predict_row(_neighbour_rows(band, corners, centres, y), row, context)
                _take_residuals(context, symbols, cursors, residual)
                _add_residuals(row, residual, under)
                if band == _CENTRES:
                    _frame_centres(row, y, centres)
                for x in range(width):
                    plane[stride * y + down, stride * x + right] = row[x]
        stride = half
    for y in range(rows):
        for x in range(columns):
            pixels[y, x] = plane[y, x] + reference[y, x]


@_compiled(int16[:, :, ::1](uint8[:, ::1], _STREAM, int64[::1]))
def restore_greens(mosaic: U8, symbols: U8, cursors: I64) -> I16:
    """Fill a mosaic's green pixels in odd rows from those in even ones; advances `cursors`.

    Returns green where red and where blue is (2, H/2, W/2).
    """
    height, width = mosaic.shape[0] // 2, mosaic.shape[1] // 2
    corners = np.empty((height + 1, width + 1), np.int16)
    centres = np.empty((height + 1, width + 1), np.int16)
    row, zeros = np.empty(width, np.int16), np.zeros(width, np.int16)
    context, residual = np.empty(width, np.uint8), np.empty(width, np.uint8)
    greens = np.empty((2, height, width), np.int16)
    _frame_corners(mosaic, 2, corners)
    for y in range(height):
        _predict_row(_neighbour_rows(_CENTRES, corners, centres, y), row, context)
        _take_residuals(context, symbols, cursors, residual)
        _add_residuals(row, residual, zeros)
        _frame_centres(row, y, centres)
        for x in range(width):
            mosaic[2 * y + 1, 2 * x + 1] = row[x]
        _predict_row(_neighbour_rows(_COLUMNS, corners, centres, y), greens[0, y], context)
        _predict_row(_neighbour_rows(_ROWS, corners, centres, y), greens[1, y], context)
    return greens


@_inlined
def _unpack_codes(codes: U8, shift: int, residual: U16) -> None:
    """Residuals 0, −1, 1 of the codes 0, 1, 2; −2 where code 3 announces an escape."""
    for x in range(residual.size):
        code = (codes[x] >> shift) & 3
        residual[x] = (code >> 1) ^ -(code & 1)


@_inlined
def _insert_escapes(residual: U16, escapes: U8, used: int) -> int:
    """Put escaped residuals in their places; returns how many escapes the surface has asked for."""
    for x in range(residual.size):
        if residual[x] == _ESCAPED:
            if used < escapes.shape[1]:
                zigzag = escapes[0, used] + 256 * escapes[1, used] + 3
                residual[x] = (zigzag >> 1) ^ -(zigzag & 1)
            used += 1
    return used


@_inlined
def _sum_row(mask: U8, residual: U16, start: int, none: int, valid: U8, row: U16) -> int:
    """Add up one row; returns its first valid value, at which the next row starts."""
    value = start
    for x in range(row.size):
        value += residual[x]
        residual[x] = value
    for byte in range(mask.size):
        for bit in range(8):
            valid[8 * byte + bit] = (mask[byte] >> bit) & 1
    for x in range(row.size):
        row[x] = residual[x] if valid[x] else none
    for x in range(row.size):
        if valid[x]:
            return int(row[x])
    return start


@_compiled(int64(_STREAM_IMAGE, _STREAM_IMAGE, _STREAM_IMAGE, uint16, uint16[:, ::1]))
def restore_surface(mask: U8, codes: U8, escapes: U8, none: int, surface: U16) -> int:
    """Fill `surface` from its mask, 2-bit codes and escapes (low bytes, high bytes).

    Returns how many escapes the codes ask for, which the caller compares with how many there are.
    """
    residual, valid = np.empty(surface.shape[1], np.uint16), np.empty(8 * mask.shape[1], np.uint8)
    used, start = 0, 0
    for y in range(surface.shape[0]):
        _unpack_codes(codes[y // 4], 2 * (y % 4), residual)
        used = _insert_escapes(residual, escapes, used)
        start = _sum_row(mask[y], residual, start, none, valid, surface[y])
    return used
