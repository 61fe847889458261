"""Loops of the live fusion, compiled: clean depth, place and colour points, blend the panorama.

All work in single precision, row by row, and allocate nothing; loops over a row have no branches where the
compiler can so make vector instructions of them. Depth is cleaned as q = numerator / z = offset − disparity,
in raw steps, where noise is the same at every distance and planes are linear in the image.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rig_protocol.compiled import compiled, inlined

F32 = np.float32
Array32 = npt.NDArray[np.float32]
U8 = npt.NDArray[np.uint8]
U16 = npt.NDArray[np.uint16]
U64 = npt.NDArray[np.uint64]
I32 = npt.NDArray[np.int32]

BAYER, BGR, GREY = 0, 1, 2
EMPTY = np.uint64(0xFFFF_FFFF_FFFF_FFFF)
"""A panorama cell on which nothing fell: farther than everything."""

_NONE = F32(1e6)  # q of a pixel without depth: a huge step to every neighbour
_MEASURED = F32(1e5)
# The offline cleaning's rules (cleaning.py, depth_model.py): a step of six sigmas, and 80 degrees.
_EDGE_SUM = F32(3 * 3.0)  # over three pixels
_COS2_STEEPEST = F32(np.cos(np.deg2rad(80.0)) ** 2)
_REACH, _LEAST_AROUND = 4, 20  # of the 9×9 pixels around a point, so many must lie on a surface
_SAME_SURFACE_M, _SAME_SURFACE_RATIO = F32(0.03), F32(0.03)  # within it two cameras measure one thing
_FRONT_RATIO = F32(1.05)  # what is farther than this times the nearest of a panorama pixel is behind it
_UNITS_A_METRE = F32(1e5)  # of a distance in the windows
_WIDEST = F32(4.0)  # squared tangent: beyond it no camera looks, and a lens polynomial may fold back
_PASSED = 32  # columns looked back for what hides a point: the parallax of 0.5 m against far away
_SHARE = F32(1.8)  # makes the weight of a camera that looks straight at a surface fill a byte
_ZERO, _HALF, _ONE, _TWO = F32(0.0), F32(0.5), F32(1.0), F32(2.0)
_PI, _HALF_PI, _TURN, _SIX = F32(np.pi), F32(np.pi / 2), F32(2 * np.pi), F32(6.0)


class Lens(NamedTuple):
    """A depth camera: disparity model, limits of q, pinhole, all f32 scalars."""

    numerator: F32
    offset: F32
    least: F32
    most: F32
    fx: F32
    fy: F32
    cx: F32
    cy: F32


class Scratch(NamedTuple):
    """What one thread needs while it works on one camera."""

    inverse: Array32  # (H,W)
    likely: Array32  # (H,W)
    solid: U8  # (H,W)
    eroded: U8  # (H,W)
    columns: npt.NDArray[np.int16]  # (W,)
    rows: Array32  # (16,W), see below
    addresses: I32  # (6,W), see below
    keys: U64  # (W,) distance and weight of a point, as they stand in a cell
    ahead: Array32  # (2,W + 32) colour columns, and room before them


# Rows of `Scratch.rows` ...
_X, _Y, _Z, _U, _V, _OWNED, _DISTANCE, _COLUMN, _ROW = range(9)
_TOTAL, _DX, _DY, _DZ, _DEPTH, _INVERSE, _WEIGHT = range(9, 16)
# ... and of `Scratch.addresses`: a partner's pixel or a cell of the window, −1 for none; flat indices of a
# point's red, blue and two green values, −1 for none; which columns are kept.
_PLACE, _RED, _BLUE, _GREEN, _OTHER_GREEN, _KEPT = range(6)


class Ring(NamedTuple):
    """Tables of all C cameras; poses (C,3,4) f32, intrinsics (C,9): fx, fy, cx, cy, k1, k2, p1, p2, k3.

    `scales`: corrected 1/z by q. `rays`: a pixel's ray in the rig frame: the point is origin + ray · z.
    `color_pixels`: its place in the colour image, (u, v) + (du, dv) / z. `partners` (C,K): cameras that
    share a view, −1 for none; `spans`: columns from and to which partner k may see what a row sees.
    """

    scales: Array32  # (C,H,W)
    rays: Array32  # (C,3,H,W)
    origins: Array32  # (C,3)
    color_pixels: Array32  # (C,4,H,W)
    T_grid_rig: Array32  # (C,3,4)
    lenses: Array32  # (C,9)
    partners: npt.NDArray[np.int64]  # (C,K)
    spans: npt.NDArray[np.int64]  # (C,K,H,2)


class Drum(NamedTuple):
    """The cylinder as the kernels need it; `starts` (C,) and `cells` (C,W',H) are every camera's window.

    A window is kept column by column, as the cameras of a ring, which stand upright, draw it row by row.
    """

    T_view_rig: Array32  # (3,4)
    azimuth_left: F32
    pixels_per_rad: F32
    slope_top: F32
    circle: int  # columns of a full circle
    starts: npt.NDArray[np.int64]
    cells: U64


class Measured(NamedTuple):
    """Cleaned depth of all cameras: 1/z (C,H,W), 1/m, and its weight 1/σ² up to a factor, 0 for none."""

    inverse: Array32
    weight: Array32


@compiled()
def clean_depth(
    image: U16, in_mm: bool, lens: Lens, scale: Array32, scratch: Scratch, inverse: Array32, weight: Array32
) -> None:
    """Smoothed 1/z (H,W) of one depth image and its weight, zero for what lies on no surface.

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
            _keep_smooth(scratch, y, scale[y], inverse[y], weight[y])
        else:
            inverse[y], weight[y] = _ONE, _ZERO


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
    half = F32(min(width, height)) * _HALF
    down_edge = F32(min(y, height - 1 - y)) + _HALF
    ray_y = (F32(y) - lens.cy) / lens.fy
    solid[0], solid[width - 1] = 0, 0
    for x in range(1, width - 1):
        c, up, down = row[x], above[x], below[x]
        left, left_up, left_down = row[x - 1], above[x - 1], below[x - 1]
        right, right_up, right_down = row[x + 1], above[x + 1], below[x + 1]
        # Sums of three rows and of three columns: of single pixels the noise alone makes steps and slopes.
        west, middle, east = left_up + left + left_down, up + c + down, right_up + right + right_down
        north, waist, south = left_up + up + right_up, left + c + right, left_down + down + right_down
        across, along = abs(west + east - _TWO * middle), abs(north + south - _TWO * waist)
        nx, ny = (east - west) * lens.fx / _SIX, (south - north) * lens.fy / _SIX
        ray_x = (F32(x) - lens.cx) / lens.fx
        nz = c - nx * ray_x - ny * ray_y
        cos2 = c * c / ((nx * nx + ny * ny + nz * nz) * (_ONE + ray_x * ray_x + ray_y * ray_y))
        good = (c < _MEASURED) & (across < _EDGE_SUM) & (along < _EDGE_SUM) & (cos2 > _COS2_STEEPEST)
        solid[x] = np.uint8(good)
        border = min(min(F32(x), F32(width - 1 - x)) + _HALF, down_edge) / half
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
def _add_row(columns: npt.NDArray[np.int16], row: U8) -> None:
    for x in range(row.size):
        columns[x] = np.int16(columns[x] + np.int16(row[x]))


@inlined
def _subtract_row(columns: npt.NDArray[np.int16], row: U8) -> None:
    for x in range(row.size):
        columns[x] = np.int16(columns[x] - np.int16(row[x]))


@inlined
def _keep_smooth(scratch: Scratch, y: int, scale: Array32, inverse: Array32, weight: Array32) -> None:
    """The mean of 3×3 pixels of a surface, which does not bend a plane; small islands lose their weight."""
    above, row, below = scratch.inverse[y - 1], scratch.inverse[y], scratch.inverse[y + 1]
    eroded, likely, columns = scratch.eroded[y], scratch.likely[y], scratch.columns
    width = row.size
    around = 0
    for x in range(min(_REACH, width)):
        around += columns[x]
    inverse[0], inverse[width - 1], weight[0], weight[width - 1] = _ONE, _ONE, _ZERO, _ZERO
    counts = scratch.rows[0]
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
        inverse[x] = total * F32(1 / 9) * scale[x] if kept else _ONE
        weight[x] = likely[x] if kept else _ZERO


@compiled()
def place_points(
    camera: int,
    measured: Measured,
    ring: Ring,
    drum: Drum,
    image: U8,
    kind: int,
    gains: U8,
    scan: int,
    scratch: Scratch,
    points: Array32,
    colors: U8,
) -> int:
    """Write the points (N,3) and colours (N,3), RGB, that this camera owns; how many. Fill its window.

    Where a partner measures the same surface, the point becomes the weighted mean of both, and only the
    camera with the larger weight owns it. `image` (h,w) is Bayer (GRBG), grey, or (h, 3·w) BGR; `gains`
    (3,256) maps R, G, B; `scan` says in which direction along the row the colour camera looks past edges.
    """
    cells = drum.cells[camera].reshape(-1)
    cells[:] = EMPTY
    height, wide = measured.inverse.shape[1], image.shape[1] // 3 if kind == BGR else image.shape[1]
    rows, addresses, flat = scratch.rows, scratch.addresses, image.reshape(-1)
    count = np.uint64(0)
    for y in range(height):
        _place_row(camera, y, measured, ring, rows)
        _merge_row(camera, y, measured, ring, rows, addresses[_PLACE])
        _project_row(drum, rows)
        _address_row(camera, drum, measured.weight[camera, y], rows, scratch.keys, addresses[_PLACE])
        _color_row(measured.weight[camera, y], wide, image.shape[0], kind, rows, addresses)
        kept = _unhidden(rows[_U], scan, scratch.ahead, addresses)
        for k in range(np.uint64(kept)):
            x = np.uint64(addresses[_KEPT, k])
            red = gains[0, flat[np.uint64(addresses[_RED, x])]]
            blue = gains[2, flat[np.uint64(addresses[_BLUE, x])]]
            greens = np.uint16(flat[np.uint64(addresses[_GREEN, x])])
            greens += np.uint16(flat[np.uint64(addresses[_OTHER_GREEN, x])])
            green = gains[1, np.uint8((greens + np.uint16(1)) >> np.uint16(1))]
            points[count, 0], points[count, 1], points[count, 2] = rows[_X, x], rows[_Y, x], rows[_Z, x]
            colors[count, 0], colors[count, 1], colors[count, 2] = red, green, blue
            count += np.uint64(rows[_OWNED, x])
            if addresses[_PLACE, x] >= 0:
                place = np.uint64(addresses[_PLACE, x])
                key = np.uint64(red) << np.uint64(16) | np.uint64(green) << np.uint64(8) | np.uint64(blue)
                cells[place] = min(cells[place], scratch.keys[x] | key)
    return int(count)


@inlined
def _place_row(camera: int, y: int, measured: Measured, ring: Ring, rows: Array32) -> None:
    """Points in the rig frame, their colour pixels, and that they are owned."""
    inverse = measured.inverse[camera, y]
    rays_x, rays_y, rays_z = ring.rays[camera, 0, y], ring.rays[camera, 1, y], ring.rays[camera, 2, y]
    u, v = ring.color_pixels[camera, 0, y], ring.color_pixels[camera, 1, y]
    du, dv = ring.color_pixels[camera, 2, y], ring.color_pixels[camera, 3, y]
    x0, y0, z0 = ring.origins[camera, 0], ring.origins[camera, 1], ring.origins[camera, 2]
    for x in range(inverse.size):
        depth = _ONE / inverse[x]
        rows[_X, x] = x0 + rays_x[x] * depth
        rows[_Y, x] = y0 + rays_y[x] * depth
        rows[_Z, x] = z0 + rays_z[x] * depth
        rows[_U, x] = u[x] + du[x] * inverse[x]
        rows[_V, x] = v[x] + dv[x] * inverse[x]
        rows[_OWNED, x] = _ONE


@inlined
def _merge_row(camera: int, y: int, measured: Measured, ring: Ring, rows: Array32, places: I32) -> None:
    """Move points to the mean of all cameras that measure the same surface; who weighs less owns nothing."""
    own = measured.weight[camera, y]
    first, last = own.size, 0
    for k in range(ring.partners.shape[1]):
        if ring.partners[camera, k] >= 0 and ring.spans[camera, k, y, 0] < ring.spans[camera, k, y, 1]:
            first = min(first, ring.spans[camera, k, y, 0])
            last = max(last, ring.spans[camera, k, y, 1])
    if first >= last:
        return
    # Unsigned: an index that might be negative keeps a loop from becoming vector instructions.
    _begin_sums(np.uint64(first), np.uint64(last), own, rows)
    for k in range(ring.partners.shape[1]):
        other = ring.partners[camera, k]
        if other >= 0 and ring.spans[camera, k, y, 0] < ring.spans[camera, k, y, 1]:
            begin, end = np.uint64(ring.spans[camera, k, y, 0]), np.uint64(ring.spans[camera, k, y, 1])
            shape = measured.inverse.shape[1], measured.inverse.shape[2]
            T, lens = ring.T_grid_rig[other], ring.lenses[other]
            if _partner_pixels(begin, end, T, lens, shape, rows, places) > 0:
                _add_partner(begin, end, other, other < camera, own, measured, ring, rows, places)
    _end_sums(np.uint64(first), np.uint64(last), rows)


@inlined
def _begin_sums(first: np.uint64, last: np.uint64, own: Array32, rows: Array32) -> None:
    for x in range(first, last):
        rows[_TOTAL, x] = own[x]
        rows[_DX, x], rows[_DY, x], rows[_DZ, x] = _ZERO, _ZERO, _ZERO


@inlined
def _end_sums(first: np.uint64, last: np.uint64, rows: Array32) -> None:
    for x in range(first, last):
        share = _ONE / max(rows[_TOTAL, x], F32(1e-20))
        rows[_X, x] += rows[_DX, x] * share
        rows[_Y, x] += rows[_DY, x] * share
        rows[_Z, x] += rows[_DZ, x] * share


@inlined
def _partner_pixels(
    begin: np.uint64,
    end: np.uint64,
    T: Array32,
    lens: Array32,
    shape: tuple[int, int],
    rows: Array32,
    places: I32,
) -> int:
    """Flat index of the partner's depth pixel on which each point falls, −1 for none, and its depth there.

    Returns how many there are.
    """
    height, width = np.int32(shape[0]), np.int32(shape[1])
    right, bottom = F32(width) - _HALF, F32(height) - _HALF
    # Read before the loop: the compiler cannot know that what the loop writes is not these tables.
    t00, t01, t02, t03 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    t10, t11, t12, t13 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    t20, t21, t22, t23 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (
        lens[0], lens[1], lens[2], lens[3], lens[4], lens[5], lens[6], lens[7], lens[8],
    )  # fmt: skip
    count = 0
    for i in range(begin, end):
        x, y, z = rows[_X, i], rows[_Y, i], rows[_Z, i]
        depth = max(t20 * x + t21 * y + t22 * z + t23, F32(0.05))
        a = (t00 * x + t01 * y + t02 * z + t03) / depth
        b = (t10 * x + t11 * y + t12 * z + t13) / depth
        r2 = a * a + b * b
        radial = _ONE + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = fx * (a * radial + _TWO * p1 * a * b + p2 * (r2 + _TWO * a * a)) + cx
        v = fy * (b * radial + p1 * (r2 + _TWO * b * b) + _TWO * p2 * a * b) + cy
        seen = (u > -_HALF) & (u < right) & (v > -_HALF) & (v < bottom) & (r2 < _WIDEST) & (depth > F32(0.1))
        column = np.int32(min(max(u + _HALF, _ZERO), right))
        row = np.int32(min(max(v + _HALF, _ZERO), bottom))
        rows[_DEPTH, i] = depth
        places[i] = np.int32(row * width + column) if seen else np.int32(-1)
        count += int(seen)
    return count


@inlined
def _add_partner(
    begin: np.uint64,
    end: np.uint64,
    other: int,
    first_of_both: bool,
    own: Array32,
    measured: Measured,
    ring: Ring,
    rows: Array32,
    places: I32,
) -> None:
    """Add what the partner measures on its own ray through each point, where that is the same surface."""
    inverse, weights = measured.inverse[other].reshape(-1), measured.weight[other].reshape(-1)
    for x in range(begin, end):  # apart from the next loop: gathers keep a loop from becoming vectors
        place = np.uint64(max(places[x], np.int32(0)))
        rows[_INVERSE, x] = inverse[place]
        rows[_WEIGHT, x] = weights[place]
    x0, y0, z0 = ring.origins[other, 0], ring.origins[other, 1], ring.origins[other, 2]
    for x in range(begin, end):
        away = _ONE / rows[_INVERSE, x] - rows[_DEPTH, x]
        same = abs(away) < _SAME_SURFACE_M + _SAME_SURFACE_RATIO * rows[_DEPTH, x]
        rows[_WEIGHT, x] = rows[_WEIGHT, x] if same & (places[x] >= 0) else _ZERO
        rows[_DEPTH, x] = (
            rows[_WEIGHT, x] * away / rows[_DEPTH, x]
        )  # by how much of the ray, times the weight
    for x in range(begin, end):
        yields = (rows[_WEIGHT, x] > own[x]) | ((rows[_WEIGHT, x] == own[x]) & first_of_both)
        rows[_OWNED, x] = _ZERO if yields else rows[_OWNED, x]
    for x in range(begin, end):
        rows[_TOTAL, x] += rows[_WEIGHT, x]
    for x in range(begin, end):
        rows[_DX, x] += rows[_DEPTH, x] * (rows[_X, x] - x0)
    for x in range(begin, end):
        rows[_DY, x] += rows[_DEPTH, x] * (rows[_Y, x] - y0)
    for x in range(begin, end):
        rows[_DZ, x] += rows[_DEPTH, x] * (rows[_Z, x] - z0)


@inlined
def _project_row(drum: Drum, rows: Array32) -> None:
    """Distance of the points from the cylinder's axis, and column and row of it, to be cut to integers."""
    T = drum.T_view_rig
    for i in range(rows.shape[1]):
        x = T[0, 0] * rows[_X, i] + T[0, 1] * rows[_Y, i] + T[0, 2] * rows[_Z, i] + T[0, 3]
        y = T[1, 0] * rows[_X, i] + T[1, 1] * rows[_Y, i] + T[1, 2] * rows[_Z, i] + T[1, 3]
        z = T[2, 0] * rows[_X, i] + T[2, 1] * rows[_Y, i] + T[2, 2] * rows[_Z, i] + T[2, 3]
        distance = max(F32(np.sqrt(x * x + y * y)), F32(1e-6))
        turned = drum.azimuth_left - _azimuth(x, y) + _HALF / drum.pixels_per_rad
        turned -= _TURN * F32(np.floor(turned / _TURN))
        rows[_DISTANCE, i] = distance
        rows[_COLUMN, i] = turned * drum.pixels_per_rad
        rows[_ROW, i] = (drum.slope_top - z / distance) * drum.pixels_per_rad + _HALF


@inlined
def _azimuth(x: F32, y: F32) -> F32:
    """atan2(y, x) to 2e-5 rad without a branch (Abramowitz & Stegun 4.4.49)."""
    ax, ay = abs(x), abs(y)
    a = min(ax, ay) / max(max(ax, ay), F32(1e-9))
    s = a * a
    series = F32(-0.3302995) + s * (F32(0.1801410) + s * (F32(-0.0851330) + s * F32(0.0208351)))
    angle = a * (F32(0.9998660) + s * series)
    angle = _HALF_PI - angle if ay > ax else angle
    angle = _PI - angle if x < _ZERO else angle
    return -angle if y < _ZERO else angle


@inlined
def _address_row(camera: int, drum: Drum, weights: Array32, rows: Array32, keys: U64, places: I32) -> None:
    """Each point's cell of the window, and its key: distance, weight and room for colour; the least stays."""
    columns, lines = np.int32(drum.cells.shape[1]), np.int32(drum.cells.shape[2])
    start, circle, bottom = np.int32(drum.starts[camera]), np.int32(drum.circle), F32(drum.cells.shape[2])
    for x in range(weights.size):
        column = np.int32(rows[_COLUMN, x]) - start
        column = column + circle if column < 0 else column
        row = np.int32(min(max(rows[_ROW, x], -_ONE), bottom))
        drawn = (column < columns) & (row < lines) & (rows[_ROW, x] >= _ZERO)
        places[x] = np.int32(column * lines + row) if drawn else np.int32(-1)
        square = rows[_DISTANCE, x] * rows[_DISTANCE, x]  # undoes q⁴: both cameras of a seam are equally far
        part = np.int32(min(max(weights[x] * square * square * _SHARE, _ONE), F32(255.0)))
        units = np.int32(min(rows[_DISTANCE, x], F32(1e4)) * _UNITS_A_METRE)
        keys[x] = np.uint64(units) << np.uint64(32) | np.uint64(part) << np.uint64(24)


@inlined
def _color_row(weights: Array32, wide: int, high: int, kind: int, rows: Array32, addresses: I32) -> None:
    """Flat indices of the values that colour each point.

    Any 2×2 pixels of a mosaic (GRBG) hold red, blue and two greens: those around a point are half a
    pixel off.
    """
    right, below, line = F32(wide - 1), F32(high - 1), np.int32(wide)
    one = np.int32(1)
    for x in range(weights.size):
        u, v = rows[_U, x], rows[_V, x]
        shown = (weights[x] > _ZERO) & (u >= _ZERO) & (u < right) & (v >= _ZERO) & (v < below)
        shift = _ZERO if kind == BAYER else _HALF
        column = np.int32(min(max(u, _ZERO), right) + shift)
        row = np.int32(min(max(v, _ZERO), below) + shift)
        place = np.int32(row * line + column)
        if kind == BAYER:
            odd_row, odd_column, mixed = row & one, column & one, (row ^ column) & one
            red = place + odd_row * line + (one - odd_column)
            blue = place + (one - odd_row) * line + odd_column
            green, other = place + mixed, place + line + (one - mixed)
        elif kind == BGR:
            red, green, blue = 3 * place + 2, 3 * place + 1, 3 * place
            other = green
        else:
            red = green = blue = other = place + 0
        addresses[_RED, x] = np.int32(red) if shown else np.int32(-1)
        addresses[_BLUE, x] = np.int32(blue)
        addresses[_GREEN, x] = np.int32(green)
        addresses[_OTHER_GREEN, x] = np.int32(other)


@inlined
def _unhidden(us: Array32, scan: int, ahead: Array32, addresses: I32) -> int:
    """List the columns of points that the colour camera sees; how many.

    Walking against the direction in which near things are shifted in the colour image, a point whose pixel
    one of the 31 before it has passed is hidden there behind something nearer.
    """
    one, width, margin = np.uint64(1), np.uint64(us.size), np.uint64(_PASSED)
    first, second = ahead[0], ahead[1]
    for x in range(width):
        place = x if scan > 0 else width - one - x
        value = us[place] if scan > 0 else -us[place]
        first[margin + x] = value if addresses[_RED, place] >= 0 else F32(-1e9)
    for shift in (1, 4):  # the largest of 4, then of 16 values up to this one
        step = np.uint64(shift)
        for x in range(margin, margin + width):
            second[x] = max(
                max(first[x], first[x - step]), max(first[x - step - step], first[x - step - step - step])
            )
        for x in range(margin, margin + width):
            first[x] = second[x]
    kept = np.uint64(0)
    for x in range(width):
        place = x if scan > 0 else width - one - x
        along = us[place] if scan > 0 else -us[place]
        passed = max(first[margin + x - one], first[margin + x - np.uint64(16)])
        addresses[_KEPT, kept] = np.int32(place)
        kept += np.uint64((addresses[_RED, place] >= 0) & (along > passed))
    return int(kept)


@compiled()
def blend_columns(
    begin: int, end: int, drum: Drum, present: U8, sums: Array32, color: U8, depth: Array32
) -> None:
    """Columns of the panorama: the weighted mean of the windows' front surfaces, BGR; NaN where is none.

    `sums` (6,H) is scratch.
    """
    for x in range(begin, end):
        sums[0], sums[1:] = F32(np.inf), _ZERO
        for step in range(2):  # all must have been looked at before the front is known
            for camera in range(drum.cells.shape[0]):
                column = (x - drum.starts[camera]) % drum.circle
                if present[camera] and column < drum.cells.shape[1]:
                    if step == 0:
                        _find_nearest(drum.cells[camera, column], sums)
                    else:
                        _add_window(drum.cells[camera, column], sums)
        for y in range(depth.shape[0]):
            total = sums[1, y]
            scale = _ONE / max(total, _ONE)
            depth[y, x] = sums[2, y] * scale / _UNITS_A_METRE if total > _ZERO else F32(np.nan)
            for channel in range(3):
                color[y, x, channel] = np.uint8(sums[5 - channel, y] * scale + _HALF)


@inlined
def _find_nearest(cells: U64, sums: Array32) -> None:
    for y in range(cells.size):
        sums[0, y] = min(sums[0, y], F32(np.uint32(cells[y] >> np.uint64(32))))


@inlined
def _add_window(cells: U64, sums: Array32) -> None:
    byte = np.uint64(255)
    for y in range(cells.size):
        key = cells[y]
        distance = F32(np.uint32(key >> np.uint64(32)))
        shown = (distance <= _FRONT_RATIO * sums[0, y]) & (key != EMPTY)
        weight = F32(np.int32(key >> np.uint64(24) & byte)) if shown else _ZERO
        sums[1, y] += weight
        sums[2, y] += weight * distance
        sums[3, y] += weight * F32(np.int32(key >> np.uint64(16) & byte))
        sums[4, y] += weight * F32(np.int32(key >> np.uint64(8) & byte))
        sums[5, y] += weight * F32(np.int32(key & byte))


@compiled()
def close_ranks(points: Array32, colors: U8, capacity: int, counts: npt.NDArray[np.int64]) -> int:
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
