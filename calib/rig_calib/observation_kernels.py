"""Residuals of observations and their derivatives, compiled: one row of numbers a scalar residual.

The columns of a camera's state: pose (rotation, translation; on the right of T_rig_camera), depth bias, colour
intrinsics (log focal, Δcx, Δcy, Δk1), pose of the grid (on the right of T_color_grid), the grid's intrinsics
(log focal, Δcx, Δcy). `observation_model.py` says what they mean.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rig_protocol.compiled import compiled, inlined

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

_MIN_DEPTH_M = 0.05
_BEHIND = 1e6
"""Residual of what is not in front of its camera: far beyond every kernel, so that no step leads there."""


class Cameras(NamedTuple):
    """C cameras with their states applied. Intrinsics are (fx, fy, cx, cy, k1, k2, p1, p2, k3).

    `grid_turn` is Exp of the rotation by which T_color_grid is corrected, `grid_turn_jacobian` its right
    Jacobian; `raw_model` (numerator_m, offset).
    """

    R_rig_camera: Array  # (C,3,3)
    t_rig_camera: Array  # (C,3)
    color: Array  # (C,9)
    R_color_grid: Array  # (C,3,3)
    t_color_grid: Array  # (C,3)
    grid: Array  # (C,9)
    raw_model: Array  # (C,2)
    bias: Array  # (C,B)
    grid_turn: Array  # (C,3,3)
    grid_turn_jacobian: Array  # (C,3,3)


class PointRows(NamedTuple):
    """M observations of points; `disparity_weight` is 1/σ, 0 for none; `basis` (M,B) is the bias's."""

    camera: Index
    point: Index
    pixels: Array
    whitener: Array
    disparity: Array
    slope: Array
    grid_pixels: Array
    disparity_weight: Array
    basis: Array


class PlaneRows(NamedTuple):
    """M disparities of planes, each on the ray (x, y, 1) of a grid pixel.

    `distorted` (M,2) are the pixel's normalised coordinates, `rays` (M,2) the same without distortion,
    `ray_by_distorted` (M,2,2) how these change with those.
    """

    camera: Index
    plane: Index
    disparity: Array
    disparity_weight: Array
    basis: Array
    grid_pixels: Array
    distorted: Array
    rays: Array
    ray_by_distorted: Array


@inlined
def _turned(R: Array, X: float, Y: float, Z: float) -> tuple[float, float, float]:
    """Rᵀ X."""
    return (
        R[0, 0] * X + R[1, 0] * Y + R[2, 0] * Z,
        R[0, 1] * X + R[1, 1] * Y + R[2, 1] * Z,
        R[0, 2] * X + R[1, 2] * Y + R[2, 2] * Z,
    )


@inlined
def _into(R: Array, t: Array, X: float, Y: float, Z: float) -> tuple[float, float, float]:
    """Rᵀ (X − t): a point moved into the frame whose pose is (R, t)."""
    return _turned(R, X - t[0], Y - t[1], Z - t[2])


@inlined
def _project(k: Array, X: float, Y: float, Z: float, J: Array) -> tuple[float, float]:
    """Pixel of a point, and its derivative J (2,4) by the point and by k1."""
    x, y = X / Z, Y / Z
    k1, k2, p1, p2, k3 = k[4], k[5], k[6], k[7], k[8]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
    fx, fy = k[0] / Z, k[1] / Z
    cross = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    J[0, 0] = fx * (radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x)
    J[0, 1] = fx * cross
    J[1, 0] = fy * cross
    J[1, 1] = fy * (radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x)
    J[0, 2] = -(J[0, 0] * x + J[0, 1] * y)
    J[1, 2] = -(J[1, 0] * x + J[1, 1] * y)
    J[0, 3], J[1, 3] = k[0] * x * r2, k[1] * y * r2
    distorted_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    distorted_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return k[0] * distorted_x + k[2], k[1] * distorted_y + k[3]


@inlined
def _by_pose(a: float, b: float, c: float, x: float, y: float, z: float, out: Array) -> None:
    """Derivative (6,) by the pose on whose right the point x, y, z moves, from (a, b, c), that by the point."""
    out[0] = b * z - c * y
    out[1] = c * x - a * z
    out[2] = a * y - b * x
    out[3], out[4], out[5] = -a, -b, -c


@inlined
def _by_landmark(R: Array, a: float, b: float, c: float, out: Array) -> None:
    for i in range(3):
        out[i] = R[i, 0] * a + R[i, 1] * b + R[i, 2] * c


@compiled()
def point_rows(
    cameras: Cameras, seen: PointRows, points: Array, residual: Array, by_state: Array, by_landmark: Array
) -> None:
    """Three rows an observation, whitened: of its pixel, two; of its disparity, one (zeros where there is none).

    `residual` (3M,), `by_state` (3M,S) and `by_landmark` (3M,3) are filled.
    """
    terms = cameras.bias.shape[1]
    J = np.empty((2, 4))
    by_state[:] = 0.0
    for m in range(len(seen.camera)):
        c, p = seen.camera[m], seen.point[m]
        R = cameras.R_rig_camera[c]
        x, y, z = _into(R, cameras.t_rig_camera[c], points[p, 0], points[p, 1], points[p, 2])
        if not z > _MIN_DEPTH_M:
            residual[3 * m : 3 * m + 3] = _BEHIND
            by_landmark[3 * m : 3 * m + 3] = 0.0
            continue
        k = cameras.color[c]
        u, v = _project(k, x, y, z, J)
        du, dv = u - seen.pixels[m, 0], v - seen.pixels[m, 1]
        for i in range(2):
            row = by_state[3 * m + i]
            w0, w1 = seen.whitener[m, i, 0], seen.whitener[m, i, 1]
            residual[3 * m + i] = w0 * du + w1 * dv
            a, b, d = (w0 * J[0, 0] + w1 * J[1, 0], w0 * J[0, 1] + w1 * J[1, 1], w0 * J[0, 2] + w1 * J[1, 2])
            _by_pose(a, b, d, x, y, z, row)
            _by_landmark(R, a, b, d, by_landmark[3 * m + i])
            row[6 + terms] = w0 * (u - k[2]) + w1 * (v - k[3])
            row[7 + terms], row[8 + terms] = w0, w1
            row[9 + terms] = w0 * J[0, 3] + w1 * J[1, 3]
        _disparity_row(cameras, seen, m, x, y, z, J, residual, by_state[3 * m + 2], by_landmark[3 * m + 2])


@inlined
def _disparity_row(
    cameras: Cameras,
    seen: PointRows,
    m: int,
    x: float,
    y: float,
    z: float,
    J: Array,
    residual: Array,
    row: Array,
    by_landmark: Array,
) -> None:
    """What the grid should have measured of the point x, y, z, less what it did, there where the point falls."""
    c, weight, terms = seen.camera[m], seen.disparity_weight[m], cameras.bias.shape[1]
    residual[3 * m + 2] = 0.0
    by_landmark[:] = 0.0
    if weight == 0.0:
        return
    X, Y, Z = _into(cameras.R_color_grid[c], cameras.t_color_grid[c], x, y, z)
    if not Z > _MIN_DEPTH_M:
        residual[3 * m + 2] = _BEHIND
        return
    k = cameras.grid[c]
    u, v = _project(k, X, Y, Z, J)
    s0, s1 = seen.slope[m, 0], seen.slope[m, 1]
    factor = 1.0
    for j in range(terms):
        factor += seen.basis[m, j] * cameras.bias[c, j]
    per_depth = cameras.raw_model[c, 0] / Z
    measured = seen.disparity[m] + s0 * (u - seen.grid_pixels[m, 0]) + s1 * (v - seen.grid_pixels[m, 1])
    residual[3 * m + 2] = weight * (cameras.raw_model[c, 1] - per_depth * factor - measured)
    for j in range(terms):
        row[6 + j] = -weight * per_depth * seen.basis[m, j]
    A = -weight * (s0 * J[0, 0] + s1 * J[1, 0])
    B = -weight * (s0 * J[0, 1] + s1 * J[1, 1])
    C = -weight * (s0 * J[0, 2] + s1 * J[1, 2]) + weight * per_depth * factor / Z
    _by_grid_turn(cameras.grid_turn_jacobian[c], A, B, C, X, Y, Z, row[10 + terms : 13 + terms])
    turn = cameras.grid_turn[c]
    for j in range(3):
        row[13 + terms + j] = -(turn[j, 0] * A + turn[j, 1] * B + turn[j, 2] * C)
    row[16 + terms] = -weight * (s0 * (u - k[2]) + s1 * (v - k[3]))
    row[17 + terms], row[18 + terms] = -weight * s0, -weight * s1
    G = cameras.R_color_grid[c]
    a = G[0, 0] * A + G[0, 1] * B + G[0, 2] * C
    b = G[1, 0] * A + G[1, 1] * B + G[1, 2] * C
    d = G[2, 0] * A + G[2, 1] * B + G[2, 2] * C
    _by_pose(a, b, d, x, y, z, row)
    _by_landmark(cameras.R_rig_camera[c], a, b, d, by_landmark)


@inlined
def _by_grid_turn(
    turn_jacobian: Array, A: float, B: float, C: float, X: float, Y: float, Z: float, out: Array
) -> None:
    """Derivative (3,) by the rotation vector that corrects T_color_grid."""
    P, Q, S = B * Z - C * Y, C * X - A * Z, A * Y - B * X
    for j in range(3):
        out[j] = P * turn_jacobian[0, j] + Q * turn_jacobian[1, j] + S * turn_jacobian[2, j]


@compiled()
def plane_rows(
    cameras: Cameras, seen: PlaneRows, planes: Array, residual: Array, by_state: Array, by_landmark: Array
) -> None:
    """One row an observation: the disparity of a plane π, π · X = 1, at a grid pixel, less what was measured.

    A plane moves into a frame (R, t) as Rᵀπ / (1 − π·t); on a ray r of that frame 1/z = π · r.
    `residual` (M,), `by_state` (M,S) and `by_landmark` (M,3) are filled.
    """
    terms = cameras.bias.shape[1]
    by_state[:] = 0.0
    by_landmark[:] = 0.0
    for m in range(len(seen.camera)):
        c, row = seen.camera[m], by_state[m]
        R, t = cameras.R_rig_camera[c], cameras.t_rig_camera[c]
        G, s, k = cameras.R_color_grid[c], cameras.t_color_grid[c], cameras.grid[c]
        plane = planes[seen.plane[m]]
        side = 1.0 - (plane[0] * t[0] + plane[1] * t[1] + plane[2] * t[2])
        a, b, d = _turned(R, plane[0] / side, plane[1] / side, plane[2] / side)
        grid_side = 1.0 - (a * s[0] + b * s[1] + d * s[2])
        A, B, C = _turned(G, a / grid_side, b / grid_side, d / grid_side)

        xd, yd = (seen.grid_pixels[m, 0] - k[2]) / k[0], (seen.grid_pixels[m, 1] - k[3]) / k[1]
        bent, dx, dy = seen.ray_by_distorted[m], xd - seen.distorted[m, 0], yd - seen.distorted[m, 1]
        x = seen.rays[m, 0] + bent[0, 0] * dx + bent[0, 1] * dy
        y = seen.rays[m, 1] + bent[1, 0] * dx + bent[1, 1] * dy
        inverse_depth = A * x + B * y + C
        if not (side > 0.0 and grid_side > 0.0 and inverse_depth > 0.0):
            residual[m] = _BEHIND
            continue
        factor = 1.0
        for j in range(terms):
            factor += seen.basis[m, j] * cameras.bias[c, j]
        scale = -seen.disparity_weight[m] * cameras.raw_model[c, 0]
        predicted = cameras.raw_model[c, 1] - cameras.raw_model[c, 0] * factor * inverse_depth
        residual[m] = seen.disparity_weight[m] * (predicted - seen.disparity[m])
        for j in range(terms):
            row[6 + j] = scale * seen.basis[m, j] * inverse_depth

        P, Q, S = scale * factor * x, scale * factor * y, scale * factor  # by the plane in the grid's frame
        along = P * A + Q * B + S * C
        turn = cameras.grid_turn[c]
        _by_grid_turn(cameras.grid_turn_jacobian[c], P, Q, S, A, B, C, row[10 + terms : 13 + terms])
        for j in range(3):
            row[13 + terms + j] = along * (turn[j, 0] * A + turn[j, 1] * B + turn[j, 2] * C)
        by_x = scale * factor * (A * bent[0, 0] + B * bent[1, 0])
        by_y = scale * factor * (A * bent[0, 1] + B * bent[1, 1])
        row[16 + terms] = -(by_x * xd + by_y * yd)
        row[17 + terms], row[18 + terms] = -by_x / k[0], -by_y / k[1]

        p = (G[0, 0] * P + G[0, 1] * Q + G[0, 2] * S + along * s[0]) / grid_side  # ... in the camera's
        q = (G[1, 0] * P + G[1, 1] * Q + G[1, 2] * S + along * s[1]) / grid_side
        r = (G[2, 0] * P + G[2, 1] * Q + G[2, 2] * S + along * s[2]) / grid_side
        _by_pose(p, q, r, a, b, d, row)
        along = p * a + q * b + r * d
        row[3], row[4], row[5] = along * a, along * b, along * d
        for i in range(3):
            turned = R[i, 0] * p + R[i, 1] * q + R[i, 2] * r
            by_landmark[m, i] = (turned + along * t[i]) / side
