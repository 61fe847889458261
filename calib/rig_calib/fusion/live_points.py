"""The live fusion's points, compiled: placed in the rig, merged in overlaps, coloured, drawn into a window.

Single precision, row by row, nothing is allocated; loops over a row have no branches, so that the compiler
makes vector instructions of them, but for the last one, which looks colours up and writes.
"""

import numpy as np

from rig_calib.fusion.live_arrays import (
    BAYER,
    BGR,
    F32,
    HALF,
    I16,
    I32,
    MARGIN,
    ONE,
    PITCH,
    TWO,
    U8,
    U32,
    UNITS_A_METRE,
    UNSEEN,
    ZERO,
    Array32,
    Drum,
    Ring,
    Scratch,
    inverse_of,
    weight_of,
)
from rig_calib.fusion.live_overlaps import OWNED, WEIGHT, U, V, X, Y, Z, merge_row
from rig_protocol.compiled import compiled, inlined

_SHARE = F32(1.8)  # makes the weight of a camera that looks straight at a surface fill a byte
_PI = F32(np.pi)
_HIDDEN = F32(-1e9)  # a colour column that passes none
_FULL = F32(255.0)
_FORWARD, _BACKWARD = np.uint64(1), np.uint64(2**64 - 1)  # steps along a row, modulo 2^64
_PITCH = np.uint64(PITCH)

# Further rows of `Scratch.rows`: distance from the cylinder's axis, column and row of the panorama; later, in
# the same place, colour columns in the direction of the scan, and the greatest so far.
_DISTANCE, _COLUMN, _ROW = (np.uint64(k * PITCH + MARGIN) for k in range(12, 15))
_ALONG, _OF_FOUR, _OF_SIXTEEN = (np.uint64(k * PITCH + MARGIN) for k in range(12, 15))
# Rows of `Scratch.places`: a cell of the window and 2×2 pixels of the colour image, −1 for none; distance in
# units; weight, as a byte.
_CELL, _QUAD, _UNITS, _PART = (np.uint64(k * PITCH + MARGIN) for k in range(4))


@compiled()
def pack_colors(image: U8, kind: int, gains: Array32, quads: U32) -> None:
    """RGB of the 2×2 pixels that begin at every pixel, or of the pixel itself, in the low 24 bits of a word.

    `image` (h,w) is a mosaic (GRBG), of which any 2×2 hold red, blue and two greens; or grey; or (h, 3·w)
    BGR. `gains` (3,): factors on R, G, B.
    """
    height, width = image.shape[0], image.shape[1] // 3 if kind == BGR else image.shape[1]
    for y in range(height):
        out = quads[y * width : (y + 1) * width]
        if kind == BAYER and y & 1 == 0:
            _pack_mosaic(image[y], image[min(y + 1, height - 1)], gains, np.uint32(0), out)
        elif kind == BAYER:
            _pack_mosaic(image[y], image[min(y + 1, height - 1)], gains, np.uint32(1), out)
        else:
            step = 3 if kind == BGR else 1
            for x in range(width):
                first = x * step
                blue, green, red = (
                    image[y, first],
                    image[y, first + step // 3],
                    image[y, first + 2 * (step // 3)],
                )
                out[x] = _rgb(F32(red) * gains[0], F32(green) * gains[1], F32(blue) * gains[2])


@inlined
def _pack_mosaic(row: U8, below: U8, gains: Array32, odd_row: np.uint32, out: U32) -> None:
    """Even rows of a mosaic are green, red, green, ..., odd ones blue, green, blue, ..."""
    red_gain, green_gain, blue_gain = gains[0], gains[1] * HALF, gains[2]
    last = np.uint64(out.size - 1)
    out[last] = np.uint32(0)  # nothing is coloured by the last column
    for x in range(last):
        right = x + np.uint64(1)
        a, b, c, d = F32(row[x]), F32(row[right]), F32(below[x]), F32(below[right])
        green_first = (np.uint32(x) ^ odd_row) & np.uint32(1) == np.uint32(0)
        own, other, green = (b, c, a + d) if green_first else (a, d, b + c)
        red, blue = (other, own) if odd_row else (own, other)
        out[x] = _rgb(red * red_gain, green * green_gain, blue * blue_gain)


@inlined
def _rgb(red: F32, green: F32, blue: F32) -> np.uint32:
    return _byte(red) << np.uint32(16) | _byte(green) << np.uint32(8) | _byte(blue)


@inlined
def _byte(value: F32) -> np.uint32:
    return np.uint32(np.int32(min(value + HALF, _FULL)))


@compiled()
def place_points(
    camera: int,
    measured: U32,
    ring: Ring,
    drum: Drum,
    size: tuple[int, int],
    kind: int,
    scan: int,
    scratch: Scratch,
    points: Array32,
    colors: U8,
) -> int:
    """Write the points (N,3) and colours (N,3), RGB, that this camera owns; how many. Fill its window.

    Where a partner measures the same surface, the point becomes the weighted mean of both, and only the
    camera with the larger weight owns it. The window must be empty. `measured` (C,H,W): packed, of all
    cameras. `size`: rows and columns of the colour image of this `kind`, which `scratch.quads` holds. `scan`
    says in which direction along the row the colour camera looks past edges.
    """
    cells = drum.cells[camera].reshape(-1)
    height, width = measured.shape[1], np.uint64(measured.shape[2])
    rows, places, quads = scratch.rows, scratch.places, scratch.quads
    count = np.uint64(0)
    for y in range(height):
        _place_row(camera, y, measured[camera, y], ring, rows)
        merge_row(camera, y, measured, ring, rows, places)
        _project_row(camera, width, drum, rows)
        _draw_row(width, drum, rows, places)
        _color_row(width, size, kind, rows, places)
        if scan > 0:
            _hide_row(width, _FORWARD, ONE, rows, places)
        else:
            _hide_row(width, _BACKWARD, -ONE, rows, places)
        for x in range(width):
            if places[_QUAD + x] >= 0:
                rgb = quads[np.uint64(places[_QUAD + x])]
                points[count, 0], points[count, 1], points[count, 2] = rows[X + x], rows[Y + x], rows[Z + x]
                colors[count, 0] = np.uint8(rgb >> np.uint32(16))
                colors[count, 1] = np.uint8(rgb >> np.uint32(8))
                colors[count, 2] = np.uint8(rgb)
                count += np.uint64(rows[OWNED + x])
                if places[_CELL + x] >= 0:
                    cell = np.uint64(places[_CELL + x])
                    low = np.uint32(places[_PART + x]) << np.uint32(24) | rgb
                    key = np.uint64(np.uint32(places[_UNITS + x])) << np.uint64(32) | np.uint64(low)
                    cells[cell] = min(cells[cell], key)
    return int(count)


@inlined
def _place_row(camera: int, y: int, measured: U32, ring: Ring, rows: Array32) -> None:
    """Points in the rig frame, their colour pixels and weights, and that they are owned."""
    tables, planes, T = ring.tables[camera], ring.planes[camera], ring.T_rig_grid[camera]
    t00, t01, t02, t03 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    t10, t11, t12, t13 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    t20, t21, t22, t23 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    # Of every table's row: where its plane begins, how it rises, and the table's step.
    a, a_rise, a_step, of_a = _table_row(planes, tables, 0, y)
    b, b_rise, b_step, of_b = _table_row(planes, tables, 1, y)
    u, u_rise, u_step, of_u = _table_row(planes, tables, 2, y)
    v, v_rise, v_step, of_v = _table_row(planes, tables, 3, y)
    du, du_rise, du_step, of_du = _table_row(planes, tables, 4, y)
    dv, dv_rise, dv_step, of_dv = _table_row(planes, tables, 5, y)
    for x in range(np.uint64(measured.size)):
        at = F32(np.int32(x))
        inverse = inverse_of(measured[x])
        depth = ONE / inverse
        ray_a = a + a_rise * at + a_step * F32(of_a[x])
        ray_b = b + b_rise * at + b_step * F32(of_b[x])
        rows[X + x] = t03 + (t00 * ray_a + t01 * ray_b + t02) * depth
        rows[Y + x] = t13 + (t10 * ray_a + t11 * ray_b + t12) * depth
        rows[Z + x] = t23 + (t20 * ray_a + t21 * ray_b + t22) * depth
        shift_u = du + du_rise * at + du_step * F32(of_du[x])
        shift_v = dv + dv_rise * at + dv_step * F32(of_dv[x])
        column = u + u_rise * at + u_step * F32(of_u[x]) + shift_u * inverse
        rows[U + x] = column if of_u[x] != UNSEEN else _HIDDEN
        rows[V + x] = v + v_rise * at + v_step * F32(of_v[x]) + shift_v * inverse
        rows[WEIGHT + x] = weight_of(measured[x])
        rows[OWNED + x] = ONE


@inlined
def _table_row(planes: Array32, tables: I16, k: int, y: int) -> tuple[F32, F32, F32, I16]:
    return planes[k, 0] + planes[k, 2] * F32(y), planes[k, 1], planes[k, 3], tables[k, y]


@inlined
def _project_row(camera: int, width: np.uint64, drum: Drum, rows: Array32) -> None:
    """Each point's distance from the cylinder's axis, and its column and row of the window, to be cut."""
    T = drum.T_window_rig[camera]
    t00, t01, t02, t03 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    t10, t11, t12, t13 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    t20, t21, t22, t23 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    scale, top, middle = drum.pixels_per_rad, drum.slope_top, F32(drum.cells.shape[1]) * HALF
    for i in range(width):
        px, py, pz = rows[X + i], rows[Y + i], rows[Z + i]
        x = t00 * px + t01 * py + t02 * pz + t03
        y = t10 * px + t11 * py + t12 * pz + t13
        z = t20 * px + t21 * py + t22 * pz + t23
        distance = F32(np.sqrt(max(x * x + y * y, F32(1e-12))))
        rows[_DISTANCE + i] = distance
        rows[_COLUMN + i] = middle - _azimuth(x, y, distance) * scale
        rows[_ROW + i] = (top - z / distance) * scale + HALF


@inlined
def _azimuth(x: F32, y: F32, distance: F32) -> F32:
    """atan2(y, x) to 4e-5 rad: twice the angle whose tangent is y / (distance + x), which takes no quadrants.

    That angle by Abramowitz & Stegun 4.4.49, or the complement of its complement.
    """
    rise, run = abs(y), max(distance + x, F32(1e-9))
    steep = rise > run
    a = (run if steep else rise) / (rise if steep else run)
    s = a * a
    series = F32(-0.3302995) + s * (F32(0.1801410) + s * (F32(-0.0851330) + s * F32(0.0208351)))
    half = a * (F32(0.9998660) + s * series)
    angle = _PI - TWO * half if steep else TWO * half
    return -angle if y < ZERO else angle


@inlined
def _draw_row(width: np.uint64, drum: Drum, rows: Array32, places: I32) -> None:
    """Each point's cell of the window, its distance in units, and its weight as a byte."""
    columns, lines = F32(drum.cells.shape[1]), F32(drum.cells.shape[2])
    line = np.int32(drum.cells.shape[2])
    for i in range(width):
        column, row = rows[_COLUMN + i], rows[_ROW + i]
        drawn = (column >= ZERO) & (column < columns) & (row >= ZERO) & (row < lines)
        cell = np.int32(min(max(column, ZERO), columns)) * line + np.int32(min(max(row, ZERO), lines))
        places[_CELL + i] = cell if drawn else np.int32(-1)
        # The fourth power undoes q⁴: both cameras of a seam are equally far.
        square = rows[_DISTANCE + i] * rows[_DISTANCE + i]
        part = rows[WEIGHT + i] * square * square * _SHARE
        places[_PART + i] = np.int32(min(max(part, ONE), _FULL))
        places[_UNITS + i] = np.int32(min(rows[_DISTANCE + i], F32(1e4)) * UNITS_A_METRE)


@inlined
def _color_row(width: np.uint64, size: tuple[int, int], kind: int, rows: Array32, places: I32) -> None:
    """What colours each point: of a mosaic the 2×2 pixels around it, half a pixel off at most."""
    high, wide = size
    right, below, line = F32(wide - 1), F32(high - 1), np.int32(wide)
    shift = ZERO if kind == BAYER else HALF
    for x in range(width):
        u, v = rows[U + x], rows[V + x]
        shown = (rows[WEIGHT + x] > ZERO) & (u >= ZERO) & (u < right) & (v >= ZERO) & (v < below)
        column = np.int32(min(max(u, ZERO), right) + shift)
        row = np.int32(min(max(v, ZERO), below) + shift)
        places[_QUAD + x] = row * line + column if shown else np.int32(-1)


@inlined
def _hide_row(width: np.uint64, scan: np.uint64, sign: F32, rows: Array32, places: I32) -> None:
    """Take colour from points that the colour camera does not see.

    Walking against the direction in which near things are shifted in the colour image, a point whose pixel
    one of the 31 before it has passed is hidden there behind something nearer: the parallax of 0.5 m against
    far away.
    """
    two, three, sixteen = scan + scan, scan + scan + scan, scan << np.uint64(4)
    four, eight, twelve = scan << np.uint64(2), scan << np.uint64(3), three << np.uint64(2)
    for x in range(width):
        shown = places[_QUAD + x] >= np.int32(0)
        rows[_ALONG + x] = sign * rows[U + x] if shown else _HIDDEN
    for x in range(np.uint64(MARGIN)):
        rows[_ALONG - np.uint64(MARGIN) + x] = _HIDDEN
        rows[_ALONG + width + x] = _HIDDEN
    for at in range(_ALONG - np.uint64(28), _ALONG + width + np.uint64(28)):
        rows[at + _PITCH] = max(max(rows[at], rows[at - scan]), max(rows[at - two], rows[at - three]))
    for at in range(_OF_FOUR - np.uint64(16), _OF_FOUR + width + np.uint64(16)):
        rows[at + _PITCH] = max(max(rows[at], rows[at - four]), max(rows[at - eight], rows[at - twelve]))
    for x in range(width):
        passed = max(rows[_OF_SIXTEEN + x - scan], rows[_OF_SIXTEEN + x - sixteen])
        place = places[_QUAD + x]
        places[_QUAD + x] = place if rows[_ALONG + x] > passed else np.int32(-1)
