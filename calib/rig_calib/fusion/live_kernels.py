"""Loops of the live fusion, compiled: clean depth, place and colour points, blend the panorama.

All work in single precision on planes of the depth image, row by row, and allocate nothing. Depth is kept
as q = numerator / z = offset − disparity, in raw steps, where noise is the same at every distance and planes
are linear in the image.
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

BAYER, BGR, GREY = 0, 1, 2
EMPTY = np.uint64(0xFFFF_FFFF_FFFF_FFFF)
"""A panorama cell on which nothing fell: farther than everything."""

_NONE = F32(1e6)  # q of a pixel without depth: a huge step to every neighbour
_MEASURED = F32(1e5)
# The offline cleaning's rules (cleaning.py, depth_model.py): a step of six sigmas, and 80 degrees.
_EDGE_STEP = F32(3.0)
_COS2_STEEPEST = F32(np.cos(np.deg2rad(80.0)) ** 2)
_REACH, _LEAST_AROUND = 4, 20  # of the 9×9 pixels around a point, so many must lie on a surface
_SAME_SURFACE_M, _SAME_SURFACE_RATIO = F32(0.03), F32(0.03)  # within it two cameras measure one thing
_FRONT_RATIO = F32(1.05)  # what is farther than this times the nearest of a panorama pixel is behind it
_SHARE = F32(1.8)  # makes the weight of a camera that looks straight at a surface fill a byte
_ZERO, _HALF, _ONE, _TWO = F32(0.0), F32(0.5), F32(1.0), F32(2.0)
_PI, _HALF_PI, _TURN = F32(np.pi), F32(np.pi / 2), F32(2 * np.pi)


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
    rows: Array32  # (9,W)


class Ring(NamedTuple):
    """Tables of all C cameras; poses (C,3,4) f32, intrinsics (C,9): fx, fy, cx, cy, k1, k2, p1, p2, k3.

    `rays`: a pixel's ray in the rig frame, times numerator and depth correction: the point is
    origin + ray / q. `color_pixels`: its place in the colour image, (u, v) + q · (du, dv).
    `partners` (C,K): cameras that share a view, −1 for none; `shared` has bit k where partner k may see
    what a pixel sees.
    """

    rays: Array32  # (C,3,H,W)
    origins: Array32  # (C,3)
    color_pixels: Array32  # (C,4,H,W)
    T_grid_rig: Array32  # (C,3,4)
    lenses: Array32  # (C,9)
    partners: npt.NDArray[np.int64]  # (C,K)
    shared: U8  # (C,H,W)


class Drum(NamedTuple):
    """The cylinder as the kernels need it; `starts` (C,) and cells (C,H,W') are every camera's window of it."""

    T_view_rig: Array32  # (3,4)
    azimuth_left: F32
    pixels_per_rad: F32
    slope_top: F32
    circle: int  # columns of a full circle
    starts: npt.NDArray[np.int64]
    cells: U64


class Measured(NamedTuple):
    """Cleaned depth of all cameras: q (C,H,W), and its weight 1/σ² up to a factor, 0 for none."""

    inverse: Array32
    weight: Array32


@compiled()
def clean_depth(image: U16, in_mm: bool, lens: Lens, scratch: Scratch, q: Array32, weight: Array32) -> None:
    """Smoothed q (H,W) of one depth image and its weight, zero for what lies on no surface.

    Flying pixels sit beside edges and holes or are steep; what interference leaves are small islands.
    """
    height, width = image.shape
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
            _keep_smooth(scratch, y, q[y], weight[y])
        else:
            q[y], weight[y] = _NONE, _ZERO


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
        c, left, right, up, down = row[x], row[x - 1], row[x + 1], above[x], below[x]
        across, along = abs(left + right - _TWO * c), abs(up + down - _TWO * c)
        nx, ny = _HALF * (right - left) * lens.fx, _HALF * (down - up) * lens.fy
        ray_x = (F32(x) - lens.cx) / lens.fx
        nz = c - nx * ray_x - ny * ray_y
        cos2 = c * c / ((nx * nx + ny * ny + nz * nz) * (_ONE + ray_x * ray_x + ray_y * ray_y))
        good = (c < _MEASURED) & (across < _EDGE_STEP) & (along < _EDGE_STEP) & (cos2 > _COS2_STEEPEST)
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
def _keep_smooth(scratch: Scratch, y: int, q: Array32, weight: Array32) -> None:
    """The mean of 3×3 pixels of a surface, which does not bend a plane; small islands lose their weight."""
    above, row, below = scratch.inverse[y - 1], scratch.inverse[y], scratch.inverse[y + 1]
    eroded, likely, columns = scratch.eroded[y], scratch.likely[y], scratch.columns
    width = row.size
    around = 0
    for x in range(min(_REACH, width)):
        around += columns[x]
    q[0], q[width - 1], weight[0], weight[width - 1] = _NONE, _NONE, _ZERO, _ZERO
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
        q[x] = total * F32(1 / 9) if kept else _NONE
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
    cells = drum.cells[camera]
    for row in range(cells.shape[0]):
        cells[row] = EMPTY
    height = measured.inverse.shape[1]
    count = 0
    for y in range(height):
        _place_row(camera, y, measured, ring, scratch.rows)
        _merge_row(camera, y, measured, ring, scratch.rows)
        _project_row(drum, scratch.rows)
        count = _paint_row(
            camera, y, measured.weight, drum, image, kind, gains, scan, scratch.rows, points, colors, count
        )
    return count


@inlined
def _place_row(camera: int, y: int, measured: Measured, ring: Ring, rows: Array32) -> None:
    """Points in the rig frame (rows 0–2), their colour pixels (3, 4), and that they are owned (5)."""
    q = measured.inverse[camera, y]
    rays_x, rays_y, rays_z = ring.rays[camera, 0, y], ring.rays[camera, 1, y], ring.rays[camera, 2, y]
    u, v = ring.color_pixels[camera, 0, y], ring.color_pixels[camera, 1, y]
    du, dv = ring.color_pixels[camera, 2, y], ring.color_pixels[camera, 3, y]
    x0, y0, z0 = ring.origins[camera, 0], ring.origins[camera, 1], ring.origins[camera, 2]
    for x in range(q.size):
        inverse = _ONE / q[x]
        rows[0, x] = x0 + rays_x[x] * inverse
        rows[1, x] = y0 + rays_y[x] * inverse
        rows[2, x] = z0 + rays_z[x] * inverse
        rows[3, x] = u[x] + du[x] * q[x]
        rows[4, x] = v[x] + dv[x] * q[x]
        rows[5, x] = _ONE


@inlined
def _merge_row(camera: int, y: int, measured: Measured, ring: Ring, rows: Array32) -> None:
    """Move points to the mean of all cameras that measure the same surface; who weighs less owns nothing."""
    height, width = measured.inverse.shape[1], measured.inverse.shape[2]
    shared, weights = ring.shared[camera, y], measured.weight[camera, y]
    for x in range(width):
        if shared[x] == 0 or weights[x] <= _ZERO:
            continue
        px, py, pz = rows[0, x], rows[1, x], rows[2, x]
        own = total = weights[x]
        sum_x, sum_y, sum_z = own * px, own * py, own * pz
        for k in range(ring.partners.shape[1]):
            if not (shared[x] >> k) & 1:
                continue
            other = ring.partners[camera, k]
            column, row, z = _pixel(ring.T_grid_rig[other], ring.lenses[other], px, py, pz)
            if column < 0 or row < 0 or column >= width or row >= height:
                continue
            weight = measured.weight[other, row, column]
            if weight <= _ZERO:
                continue
            inverse = _ONE / measured.inverse[other, row, column]
            ox = ring.origins[other, 0] + ring.rays[other, 0, row, column] * inverse
            oy = ring.origins[other, 1] + ring.rays[other, 1, row, column] * inverse
            oz = ring.origins[other, 2] + ring.rays[other, 2, row, column] * inverse
            tolerance = _SAME_SURFACE_M + _SAME_SURFACE_RATIO * z
            away = (ox - px) * (ox - px) + (oy - py) * (oy - py) + (oz - pz) * (oz - pz)
            if away > tolerance * tolerance:
                continue
            total += weight
            sum_x, sum_y, sum_z = sum_x + weight * ox, sum_y + weight * oy, sum_z + weight * oz
            if weight > own or (weight == own and other < camera):
                rows[5, x] = _ZERO
        rows[0, x], rows[1, x], rows[2, x] = sum_x / total, sum_y / total, sum_z / total


@inlined
def _pixel(T: Array32, lens: Array32, x: F32, y: F32, z: F32) -> tuple[int, int, F32]:
    """Column and row of the depth pixel on which a point falls, −1 behind the camera, and its depth."""
    depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    if depth < F32(0.1):
        return -1, -1, depth
    a = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / depth
    b = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / depth
    r2 = a * a + b * b
    radial = _ONE + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
    u = a * radial + _TWO * lens[6] * a * b + lens[7] * (r2 + _TWO * a * a)
    v = b * radial + lens[6] * (r2 + _TWO * b * b) + _TWO * lens[7] * a * b
    u = lens[0] * u + lens[2] + _HALF
    v = lens[1] * v + lens[3] + _HALF
    if not (_ZERO <= u < F32(1e5) and _ZERO <= v < F32(1e5)):
        return -1, -1, depth
    return int(u), int(v), depth


@inlined
def _project_row(drum: Drum, rows: Array32) -> None:
    """Distance from the cylinder's axis (row 6), and column and row of it (7, 8), of the points."""
    T = drum.T_view_rig
    for i in range(rows.shape[1]):
        x = T[0, 0] * rows[0, i] + T[0, 1] * rows[1, i] + T[0, 2] * rows[2, i] + T[0, 3]
        y = T[1, 0] * rows[0, i] + T[1, 1] * rows[1, i] + T[1, 2] * rows[2, i] + T[1, 3]
        z = T[2, 0] * rows[0, i] + T[2, 1] * rows[1, i] + T[2, 2] * rows[2, i] + T[2, 3]
        distance = max(F32(np.sqrt(x * x + y * y)), F32(1e-6))
        turned = drum.azimuth_left - _azimuth(x, y) + _HALF / drum.pixels_per_rad
        turned -= _TURN * F32(np.floor(turned / _TURN))
        rows[6, i] = distance
        rows[7, i] = turned * drum.pixels_per_rad
        rows[8, i] = (drum.slope_top - z / distance) * drum.pixels_per_rad + _HALF


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
def _paint_row(
    camera: int,
    y: int,
    weights: Array32,
    drum: Drum,
    image: U8,
    kind: int,
    gains: U8,
    scan: int,
    rows: Array32,
    points: Array32,
    colors: U8,
    count: int,
) -> int:
    """Colour the points of one row, write those that are owned, and draw all into the window.

    Walking against the direction in which near things are shifted in the colour image, a point whose pixel
    one passed before is hidden there behind something nearer.
    """
    width, high = weights.shape[2], image.shape[0]
    wide = image.shape[1] // 3 if kind == BGR else image.shape[1]
    farthest = F32(-1e9)
    for step in range(width):
        x = step if scan > 0 else width - 1 - step
        weight = weights[camera, y, x]
        if weight <= _ZERO:
            continue
        u, v = rows[3, x], rows[4, x]
        along = u if scan > 0 else -u
        if along <= farthest or not (_ZERO <= u < F32(wide - 1) and _ZERO <= v < F32(high - 1)):
            continue
        farthest = along
        red, green, blue = _color(image, kind, u, v)
        red, green, blue = gains[0, red], gains[1, green], gains[2, blue]
        if rows[5, x] > _ZERO:
            points[count, 0], points[count, 1], points[count, 2] = rows[0, x], rows[1, x], rows[2, x]
            colors[count, 0], colors[count, 1], colors[count, 2] = red, green, blue
            count += 1
        _draw(drum, camera, rows, x, weight, red, green, blue)
    return count


@inlined
def _color(image: U8, kind: int, u: F32, v: F32) -> tuple[int, int, int]:
    """RGB at a pixel that has a right and a lower neighbour.

    Any 2×2 pixels of a mosaic hold red, blue and two greens: those around (u, v) are half a pixel off at most.
    """
    if kind == BAYER:
        column, row = int(u), int(v)
        top, bottom = image[row], image[row + 1]
        a, b, c, d = top[column], top[column + 1], bottom[column], bottom[column + 1]
        if row & 1:
            a, b, c, d = c, d, a, b
        if column & 1:
            a, b, c, d = b, a, d, c
        return int(b), (int(a) + int(d) + 1) >> 1, int(c)
    column, row = int(u + _HALF), int(v + _HALF)
    if kind == BGR:
        return int(image[row, 3 * column + 2]), int(image[row, 3 * column + 1]), int(image[row, 3 * column])
    return int(image[row, column]), int(image[row, column]), int(image[row, column])


@inlined
def _draw(
    drum: Drum, camera: int, rows: Array32, x: int, weight: F32, red: int, green: int, blue: int
) -> None:
    """Draw a point into its camera's window: distance, weight and colour in one number, the nearest wins."""
    cells = drum.cells[camera]
    column = int(rows[7, x]) - drum.starts[camera]
    if column < 0:
        column += drum.circle
    if rows[8, x] < _ZERO:
        return
    row = int(rows[8, x])
    if column < 0 or column >= cells.shape[1] or row >= cells.shape[0]:
        return
    key = np.uint64(rows[6, x] * F32(1e5)) << np.uint64(32)  # 10 micrometres
    square = rows[6, x] * rows[6, x]  # undoes q⁴: both cameras of a seam are equally far
    share = np.uint64(min(max(weight * square * square * _SHARE, _ONE), F32(255.0)))
    key |= share << np.uint64(24) | np.uint64(red) << np.uint64(16)
    key |= np.uint64(green) << np.uint64(8) | np.uint64(blue)
    if key < cells[row, column]:
        cells[row, column] = key


@compiled()
def blend_rows(
    first: int, last: int, drum: Drum, present: U8, sums: Array32, color: U8, depth: Array32
) -> None:
    """Rows of the panorama: the weighted mean of the windows' front surfaces, BGR; NaN where there is none.

    `sums` (6,W) is scratch.
    """
    width = depth.shape[1]
    for row in range(first, last):
        sums[0], sums[1:] = F32(np.inf), _ZERO
        for camera in range(drum.cells.shape[0]):
            if present[camera]:
                _find_nearest(drum, camera, row, sums)
        for camera in range(drum.cells.shape[0]):
            if present[camera]:
                _add_window(drum, camera, row, sums)
        for x in range(width):
            total = sums[1, x]
            depth[row, x] = sums[2, x] / total if total > _ZERO else F32(np.nan)
            scale = _ONE / total if total > _ZERO else _ZERO
            for channel in range(3):
                color[row, x, channel] = np.uint8(sums[5 - channel, x] * scale + _HALF)


@inlined
def _find_nearest(drum: Drum, camera: int, row: int, sums: Array32) -> None:
    cells = drum.cells[camera, row]
    for i in range(cells.size):
        x = drum.starts[camera] + i
        x = x - drum.circle if x >= drum.circle else x
        if x < sums.shape[1] and cells[i] != EMPTY:
            sums[0, x] = min(sums[0, x], F32(cells[i] >> np.uint64(32)))


@inlined
def _add_window(drum: Drum, camera: int, row: int, sums: Array32) -> None:
    cells = drum.cells[camera, row]
    byte = np.uint64(255)
    for i in range(cells.size):
        x = drum.starts[camera] + i
        x = x - drum.circle if x >= drum.circle else x
        key = cells[i]
        if x >= sums.shape[1] or key == EMPTY:
            continue
        distance = F32(key >> np.uint64(32))
        if distance > _FRONT_RATIO * sums[0, x]:
            continue
        weight = F32(key >> np.uint64(24) & byte)
        sums[1, x] += weight
        sums[2, x] += weight * distance * F32(1e-5)
        sums[3, x] += weight * F32(key >> np.uint64(16) & byte)
        sums[4, x] += weight * F32(key >> np.uint64(8) & byte)
        sums[5, x] += weight * F32(key & byte)


@compiled()
def close_ranks(
    points: Array32, colors: U8, capacity: int, counts: npt.NDArray[np.int64]
) -> int:
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
