"""The live fusion's cleaning of depth images, compiled: flying pixels, interference and steep surfaces go.

Depth is cleaned as q = numerator / z = offset − disparity, in raw steps, where noise is the same at every
distance and planes are linear in the image. Single precision, row by row, nothing is allocated; loops over
a row have no branches, so that the compiler makes vector instructions of them.
"""

import numpy as np

from rig_calib.fusion.live_arrays import (
    F32,
    HALF,
    I16,
    NOTHING,
    ONE,
    TWO,
    U8,
    U16,
    U32,
    Array32,
    Lens,
    Scratch,
    packed,
)
from rig_protocol.compiled import compiled, inlined

_NONE = F32(1e6)  # q of a pixel without depth: a huge step to every neighbour
_MEASURED = F32(1e5)
# The offline cleaning's rules (cleaning.py, depth_model.py): a step of six sigmas, and 80 degrees.
_EDGE_SUM = F32(3 * 3.0)  # over three pixels
_COS2_STEEPEST = F32(np.cos(np.deg2rad(80.0)) ** 2)
_REACH, _LEAST_AROUND = 4, 20  # of the 9×9 pixels around a point, so many must lie on a surface
_SIX = F32(6.0)


@compiled()
def clean_depth(image: U16, in_mm: bool, lens: Lens, scale: Array32, scratch: Scratch, measured: U32) -> None:
    """Smoothed 1/z (H,W) of one depth image with its weight, packed; no weight for what lies on no surface.

    `scale` (H,W) makes 1/z of q.

    Flying pixels sit beside edges and holes or are steep; what interference leaves are small islands.
    """
    height = image.shape[0]
    for y in range(height):
        _inverse_depth(image[y], in_mm, lens, scratch.inverse[y])
    scratch.solid[0], scratch.solid[height - 1] = 0, 0
    for y in range(1, height - 1):
        _on_surface(scratch, y, lens, height)
    scratch.eroded[0], scratch.eroded[height - 1] = 0, 0
    for y in range(1, height - 1):
        _erode(scratch.solid[y - 1], scratch.solid[y], scratch.solid[y + 1], scratch.eroded[y])
    scratch.columns[:] = 0
    for y in range(min(_REACH, height)):
        _add_row(scratch.columns, scratch.eroded[y])
    for y in range(height):
        if y + _REACH < height:
            _add_row(scratch.columns, scratch.eroded[y + _REACH])
        if y > _REACH:
            _subtract_row(scratch.columns, scratch.eroded[y - _REACH - 1])
        if 0 < y < height - 1:
            _keep_smooth(scratch, y, scale[y], measured[y])
        else:
            measured[y] = NOTHING


@inlined
def _inverse_depth(image: U16, in_mm: bool, lens: Lens, q: Array32) -> None:
    for x in range(image.size):
        if in_mm:
            value = F32(1000.0) * lens.numerator / max(F32(image[x]), F32(1e-3))
        else:
            value = lens.offset - F32(image[x])
        q[x] = value if lens.least <= value <= lens.most else _NONE


@inlined
def _on_surface(scratch: Scratch, y: int, lens: Lens, height: int) -> None:
    """Mark pixels of row y away from steps and holes, not too steep, and weigh them.

    The weight is cos²·q⁴ (σ_z grows with z² and 1/cos) times the squared distance from the border, so that
    a camera comes in smoothly at a seam.
    """
    above, row, below = scratch.inverse[y - 1], scratch.inverse[y], scratch.inverse[y + 1]
    solid, likely = scratch.solid[y], scratch.likely[y]
    width = row.size
    # Factors: a loop over pixels has no time for divisions.
    of_half, of_fx = ONE / (F32(min(width, height)) * HALF), ONE / lens.fx
    slope_x, slope_y = lens.fx / _SIX, lens.fy / _SIX
    down_edge = F32(min(y, height - 1 - y)) + HALF
    ray_y = (F32(y) - lens.cy) / lens.fy
    solid[0], solid[width - 1] = 0, 0
    for x in range(1, width - 1):
        c, up, down = row[x], above[x], below[x]
        left, left_up, left_down = row[x - 1], above[x - 1], below[x - 1]
        right, right_up, right_down = row[x + 1], above[x + 1], below[x + 1]
        # Sums of three rows and of three columns: of single pixels the noise alone makes steps and slopes.
        west, middle, east = left_up + left + left_down, up + c + down, right_up + right + right_down
        north, waist, south = left_up + up + right_up, left + c + right, left_down + down + right_down
        across, along = abs(west + east - TWO * middle), abs(north + south - TWO * waist)
        nx, ny = (east - west) * slope_x, (south - north) * slope_y
        ray_x = (F32(x) - lens.cx) * of_fx
        nz = c - nx * ray_x - ny * ray_y
        cos2 = c * c / ((nx * nx + ny * ny + nz * nz) * (ONE + ray_x * ray_x + ray_y * ray_y))
        good = (c < _MEASURED) & (across < _EDGE_SUM) & (along < _EDGE_SUM) & (cos2 > _COS2_STEEPEST)
        solid[x] = np.uint8(good)
        border = min(min(F32(x), F32(width - 1 - x)) + HALF, down_edge) * of_half
        scaled = c * F32(0.01)
        likely[x] = cos2 * (scaled * scaled) * (scaled * scaled) * border * border


@inlined
def _erode(above: U8, row: U8, below: U8, out: U8) -> None:
    width = row.size
    out[0], out[width - 1] = 0, 0
    for x in range(1, width - 1):
        out[x] = (
            above[x - 1] & above[x] & above[x + 1]
            & row[x - 1] & row[x] & row[x + 1]
            & below[x - 1] & below[x] & below[x + 1]
        )  # fmt: skip


@inlined
def _add_row(columns: I16, row: U8) -> None:
    for x in range(row.size):
        columns[x] = np.int16(columns[x] + np.int16(row[x]))


@inlined
def _subtract_row(columns: I16, row: U8) -> None:
    for x in range(row.size):
        columns[x] = np.int16(columns[x] - np.int16(row[x]))


@inlined
def _keep_smooth(scratch: Scratch, y: int, scale: Array32, measured: U32) -> None:
    """The mean of 3×3 pixels of a surface, which does not bend a plane; small islands lose their weight."""
    above, row, below = scratch.inverse[y - 1], scratch.inverse[y], scratch.inverse[y + 1]
    eroded, likely, columns = scratch.eroded[y], scratch.likely[y], scratch.columns
    width = row.size
    around = 0
    for x in range(min(_REACH, width)):
        around += columns[x]
    measured[0] = measured[width - 1] = NOTHING
    counts = scratch.rows
    for x in range(width):
        if x + _REACH < width:
            around += columns[x + _REACH]
        if x > _REACH:
            around -= columns[x - _REACH - 1]
        counts[x] = F32(around)
    for x in range(1, width - 1):
        total = above[x - 1] + above[x] + above[x + 1] + row[x - 1] + row[x] + row[x + 1]
        total += below[x - 1] + below[x] + below[x + 1]
        kept = (eroded[x] != 0) & (counts[x] >= F32(_LEAST_AROUND))
        inverse = total * F32(1 / 9) * scale[x]
        measured[x] = packed(inverse, likely[x]) if kept else NOTHING
