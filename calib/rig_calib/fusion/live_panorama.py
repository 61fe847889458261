"""The live fusion's panorama, compiled: windows of all cameras blended; and the cloud, closed up."""

import numpy as np

from rig_calib.fusion.live_arrays import (
    EMPTY,
    F32,
    HALF,
    I64,
    MARGIN,
    ONE,
    PITCH,
    U8,
    U32,
    U64,
    UNITS_A_METRE,
    ZERO,
    Array32,
    Drum,
)
from rig_protocol.compiled import compiled, inlined

_FRONT_RATIO = F32(1.05)  # what is farther than this times the nearest of a panorama pixel is behind it


# Rows of `Scratch.rows`: the nearest of every pixel of a column, and weighted sums.
_NEAREST, _TOTAL, _DISTANCE, _RED, _GREEN, _BLUE = (np.uint64(k * PITCH + MARGIN) for k in range(6))


@compiled()
def blend_columns(
    begin: int, end: int, drum: Drum, present: U8, rows: Array32, colors: U32, depths: Array32
) -> None:
    """Columns of the panorama, each a row of `colors` and `depths` (end − begin, H): blended front surfaces.

    Colours are 0xRRGGBB, depths NaN where nothing was measured. Empties the windows' columns.
    """
    height = np.uint64(drum.cells.shape[2])
    for x in range(begin, end):
        for y in range(height):
            rows[_NEAREST + y] = F32(np.inf)
            rows[_TOTAL + y] = rows[_DISTANCE + y] = ZERO
            rows[_RED + y] = rows[_GREEN + y] = rows[_BLUE + y] = ZERO
        for step in range(2):  # all must have been looked at before the front is known
            for camera in range(drum.cells.shape[0]):
                column = (x - drum.starts[camera]) % drum.circle
                if present[camera] and column < drum.cells.shape[1]:
                    if step == 0:
                        _find_nearest(height, drum.cells[camera, column], rows)
                    else:
                        _add_window(height, drum.cells[camera, column], rows)
        _divide(height, rows, colors[x - begin], depths[x - begin])


@inlined
def _divide(height: np.uint64, rows: Array32, colors: U32, depths: Array32) -> None:
    for y in range(height):
        total = rows[_TOTAL + y]
        scale = ONE / max(total, ONE)
        depths[y] = rows[_DISTANCE + y] * scale / UNITS_A_METRE if total > ZERO else F32(np.nan)
        red = np.int32(rows[_RED + y] * scale + HALF)
        green = np.int32(rows[_GREEN + y] * scale + HALF)
        blue = np.int32(rows[_BLUE + y] * scale + HALF)
        colors[y] = np.uint32(red << np.int32(16) | green << np.int32(8) | blue)


@inlined
def _find_nearest(height: np.uint64, cells: U64, rows: Array32) -> None:
    for y in range(height):
        rows[_NEAREST + y] = min(rows[_NEAREST + y], F32(np.uint32(cells[y] >> np.uint64(32))))


@inlined
def _add_window(height: np.uint64, cells: U64, rows: Array32) -> None:
    byte = np.uint32(255)
    for y in range(height):
        distance = F32(np.uint32(cells[y] >> np.uint64(32)))
        low = np.uint32(cells[y])
        shown = (distance <= _FRONT_RATIO * rows[_NEAREST + y]) & (cells[y] != EMPTY)
        weight = F32(np.int32(low >> np.uint32(24))) if shown else ZERO
        rows[_TOTAL + y] += weight
        rows[_DISTANCE + y] += weight * distance
        rows[_RED + y] += weight * F32(np.int32(low >> np.uint32(16) & byte))
        rows[_GREEN + y] += weight * F32(np.int32(low >> np.uint32(8) & byte))
        rows[_BLUE + y] += weight * F32(np.int32(low & byte))
    cells[:] = EMPTY


@compiled()
def close_ranks(points: Array32, colors: U8, capacity: int, counts: I64) -> int:
    """Move every camera's points, which begin at multiples of `capacity`, up to those before; how many."""
    end = 0
    for camera in range(counts.size):
        start = camera * capacity
        if start != end:
            for i in range(counts[camera]):
                for axis in range(3):
                    points[end + i, axis] = points[start + i, axis]
                    colors[end + i, axis] = colors[start + i, axis]
        end += counts[camera]
    return end
