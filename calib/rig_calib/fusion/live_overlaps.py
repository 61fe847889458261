"""Overlaps of the live fusion, compiled: what several cameras measure becomes one surface with one owner.

A row of a camera's points looks into the depth images of its partners.
"""

import numpy as np

from rig_calib.fusion.live_arrays import (
    F32,
    HALF,
    I32,
    MARGIN,
    ONE,
    PITCH,
    TWO,
    U32,
    ZERO,
    Array32,
    Ring,
    inverse_of,
    weight_of,
)
from rig_protocol.compiled import inlined

_SAME_SURFACE_M, _SAME_SURFACE_RATIO = F32(0.03), F32(0.03)  # within it two cameras measure one thing
_WIDEST = F32(4.0)  # squared tangent: beyond it no camera looks, and a lens polynomial may fold back

# Rows of `Scratch.rows`: the points, whether this camera owns them and their weights; then what is summed up
# of the partners: weights, weighted shifts, and the depth of a point in a partner's frame.
X, Y, Z, OWNED, WEIGHT, U, V, _TOTAL, _DX, _DY, _DZ, _DEPTH = (
    np.uint64(k * PITCH + MARGIN) for k in range(12)
)
# Rows of `Scratch.places`: a partner's pixel, −1 for none, and what it measures there.
_PIXEL, _FOUND = np.uint64(MARGIN), np.uint64(PITCH + MARGIN)


@inlined
def merge_row(camera: int, y: int, measured: U32, ring: Ring, rows: Array32, places: I32) -> None:
    """Move points to the mean of all cameras that measure the same surface; who weighs less owns nothing."""
    first, last = measured.shape[2], 0
    for k in range(ring.partners.shape[1]):
        if ring.partners[camera, k] >= 0 and ring.spans[camera, k, y, 0] < ring.spans[camera, k, y, 1]:
            first = min(first, ring.spans[camera, k, y, 0])
            last = max(last, ring.spans[camera, k, y, 1])
    if first >= last:
        return
    # Unsigned: an index that might be negative keeps a loop from becoming vector instructions.
    _begin_sums(np.uint64(first), np.uint64(last), rows)
    for k in range(ring.partners.shape[1]):
        other = ring.partners[camera, k]
        if other >= 0 and ring.spans[camera, k, y, 0] < ring.spans[camera, k, y, 1]:
            begin, end = np.uint64(ring.spans[camera, k, y, 0]), np.uint64(ring.spans[camera, k, y, 1])
            shape = measured.shape[1], measured.shape[2]
            if (
                _partner_pixels(begin, end, ring.T_grid_rig[other], ring.lenses[other], shape, rows, places)
                > 0
            ):
                _look(begin, end, measured[other].reshape(-1), places)
                _add_partner(begin, end, ring.T_rig_grid[other, :, 3], other < camera, rows, places)
    _end_sums(np.uint64(first), np.uint64(last), rows)


@inlined
def _begin_sums(first: np.uint64, last: np.uint64, rows: Array32) -> None:
    for x in range(first, last):
        rows[_TOTAL + x] = rows[WEIGHT + x]
        rows[_DX + x] = ZERO
        rows[_DY + x] = ZERO
        rows[_DZ + x] = ZERO


@inlined
def _end_sums(first: np.uint64, last: np.uint64, rows: Array32) -> None:
    for x in range(first, last):
        share = ONE / max(rows[_TOTAL + x], F32(1e-20))
        rows[X + x] += rows[_DX + x] * share
        rows[Y + x] += rows[_DY + x] * share
        rows[Z + x] += rows[_DZ + x] * share


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
    right, bottom = F32(width) - HALF, F32(height) - HALF
    # Read before the loop: the compiler cannot know that what the loop writes is not these tables.
    t00, t01, t02, t03 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    t10, t11, t12, t13 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    t20, t21, t22, t23 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (
        lens[0], lens[1], lens[2], lens[3], lens[4], lens[5], lens[6], lens[7], lens[8],
    )  # fmt: skip
    count = np.int32(0)
    for i in range(begin, end):
        x, y, z = rows[X + i], rows[Y + i], rows[Z + i]
        depth = max(t20 * x + t21 * y + t22 * z + t23, F32(0.05))
        closeness = ONE / depth
        a = (t00 * x + t01 * y + t02 * z + t03) * closeness
        b = (t10 * x + t11 * y + t12 * z + t13) * closeness
        r2 = a * a + b * b
        radial = ONE + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = fx * (a * radial + TWO * p1 * a * b + p2 * (r2 + TWO * a * a)) + cx
        v = fy * (b * radial + p1 * (r2 + TWO * b * b) + TWO * p2 * a * b) + cy
        seen = (u > -HALF) & (u < right) & (v > -HALF) & (v < bottom) & (r2 < _WIDEST) & (depth > F32(0.1))
        column = np.int32(min(max(u + HALF, ZERO), right))
        row = np.int32(min(max(v + HALF, ZERO), bottom))
        rows[_DEPTH + i] = depth
        places[_PIXEL + i] = row * width + column if seen else np.int32(-1)
        count += np.int32(seen)
    return int(count)


@inlined
def _look(begin: np.uint64, end: np.uint64, measured: U32, places: I32) -> None:
    """Apart from what is reckoned: gathers keep a loop from becoming vector instructions."""
    for x in range(begin, end):
        places[_FOUND + x] = np.int32(measured[np.uint64(max(places[_PIXEL + x], np.int32(0)))])


@inlined
def _add_partner(
    begin: np.uint64, end: np.uint64, origin: Array32, first_of_both: bool, rows: Array32, places: I32
) -> None:
    """Add what the partner measures on its own ray through each point, where that is the same surface."""
    x0, y0, z0 = origin[0], origin[1], origin[2]
    wins = np.int32(first_of_both)
    for x in range(begin, end):
        found = np.uint32(places[_FOUND + x])
        depth, own = rows[_DEPTH + x], rows[WEIGHT + x]
        stretch = ONE / (inverse_of(found) * depth) - ONE  # from the point to the surface, as part of the ray
        same = (abs(stretch * depth) < _SAME_SURFACE_M + _SAME_SURFACE_RATIO * depth) & (
            places[_PIXEL + x] >= np.int32(0)
        )
        weight = weight_of(found) if same else ZERO
        yields = (weight > own) | ((weight == own) & (wins > np.int32(0)))
        rows[OWNED + x] = ZERO if yields else rows[OWNED + x]
        rows[_TOTAL + x] += weight
        share = weight * stretch
        rows[_DX + x] += share * (rows[X + x] - x0)
        rows[_DY + x] += share * (rows[Y + x] - y0)
        rows[_DZ + x] += share * (rows[Z + x] - z0)
