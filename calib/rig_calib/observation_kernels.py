"""Residuals of observations and their derivatives, compiled: one row of numbers a scalar residual.

The columns of a camera's state: pose (rotation, translation; on the right of T_rig_camera), depth bias,
colour intrinsics (log focal, Δcx, Δcy, Δk1), pose of the grid (on the right of T_color_grid), the grid's
intrinsics (log focal, Δcx, Δcy). `observation_model.py` says what they mean.
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
def _turned(R: Array, c: int, X: float, Y: float, Z: float) -> tuple[float, float, float]:
    """R[c]ᵀ X. Arrays go with an index: views of them would be counted, which costs more than the sums."""
    return (
        R[c, 0, 0] * X + R[c, 1, 0] * Y + R[c, 2, 0] * Z,
        R[c, 0, 1] * X + R[c, 1, 1] * Y + R[c, 2, 1] * Z,
        R[c, 0, 2] * X + R[c, 1, 2] * Y + R[c, 2, 2] * Z,
    )


@inlined
def _turned_back(R: Array, c: int, X: float, Y: float, Z: float) -> tuple[float, float, float]:
    """R[c] X."""
    return (
        R[c, 0, 0] * X + R[c, 0, 1] * Y + R[c, 0, 2] * Z,
        R[c, 1, 0] * X + R[c, 1, 1] * Y + R[c, 1, 2] * Z,
        R[c, 2, 0] * X + R[c, 2, 1] * Y + R[c, 2, 2] * Z,
    )


@inlined
def distorted(k: Array, c: int, x: float, y: float) -> tuple[float, float]:
    """Distorted normalised coordinates of a ray, by the intrinsics k[c]."""
    k1, k2, p1, p2, k3 = k[c, 4], k[c, 5], k[c, 6], k[c, 7], k[c, 8]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


@inlined
def _project(k: Array, c: int, X: float, Y: float, Z: float, J: Array) -> tuple[float, float]:
    """Pixel of a point, and its derivative J (2,4) by the point and by k1."""
    x, y = X / Z, Y / Z
    k1, k2, p1, p2, k3 = k[c, 4], k[c, 5], k[c, 6], k[c, 7], k[c, 8]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
    fx, fy = k[c, 0] / Z, k[c, 1] / Z
    cross = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    J[0, 0] = fx * (radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x)
    J[0, 1] = fx * cross
    J[1, 0] = fy * cross
    J[1, 1] = fy * (radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x)
    J[0, 2] = -(J[0, 0] * x + J[0, 1] * y)
    J[1, 2] = -(J[1, 0] * x + J[1, 1] * y)
    J[0, 3], J[1, 3] = k[c, 0] * x * r2, k[c, 1] * y * r2
    x, y = distorted(k, c, x, y)
    return k[c, 0] * x + k[c, 2], k[c, 1] * y + k[c, 3]


@inlined
def _by_pose(a: float, b: float, c: float, x: float, y: float, z: float, out: Array, row: int) -> None:
    """Derivative by the pose on whose right the point x, y, z moves, from (a, b, c), that by the point."""
    out[row, 0] = b * z - c * y
    out[row, 1] = c * x - a * z
    out[row, 2] = a * y - b * x
    out[row, 3], out[row, 4], out[row, 5] = -a, -b, -c


@inlined
def _by_grid_turn(
    turn_jacobian: Array,
    c: int,
    A: float,
    B: float,
    C: float,
    X: float,
    Y: float,
    Z: float,
    out: Array,
    row: int,
    column: int,
) -> None:
    """Derivative by the rotation vector that corrects T_color_grid."""
    a, b, d = _turned(turn_jacobian, c, B * Z - C * Y, C * X - A * Z, A * Y - B * X)
    out[row, column], out[row, column + 1], out[row, column + 2] = a, b, d


@compiled()
def pixel_rows(
    cameras: Cameras, seen: PointRows, points: Array, residual: Array, by_state: Array, by_landmark: Array
) -> None:
    """Fill the first two of an observation's three rows: of its pixel, whitened.

    `residual` (3M,), `by_state` (3M,S) and `by_landmark` (3M,3) hold zeros before.
    """
    first = 6 + cameras.bias.shape[1]
    J, t, color = np.empty((2, 4)), cameras.t_rig_camera, cameras.color
    for m in range(len(seen.camera)):
        c, p = seen.camera[m], seen.point[m]
        x, y, z = points[p, 0] - t[c, 0], points[p, 1] - t[c, 1], points[p, 2] - t[c, 2]
        x, y, z = _turned(cameras.R_rig_camera, c, x, y, z)
        if not z > _MIN_DEPTH_M:
            residual[3 * m] = residual[3 * m + 1] = _BEHIND
            continue
        u, v = _project(color, c, x, y, z, J)
        du, dv = u - seen.pixels[m, 0], v - seen.pixels[m, 1]
        for row in range(3 * m, 3 * m + 2):
            w0, w1 = seen.whitener[m, row - 3 * m, 0], seen.whitener[m, row - 3 * m, 1]
            residual[row] = w0 * du + w1 * dv
            a, b, d = w0 * J[0, 0] + w1 * J[1, 0], w0 * J[0, 1] + w1 * J[1, 1], w0 * J[0, 2] + w1 * J[1, 2]
            _by_pose(a, b, d, x, y, z, by_state, row)
            by_state[row, first] = w0 * (u - color[c, 2]) + w1 * (v - color[c, 3])
            by_state[row, first + 1], by_state[row, first + 2] = w0, w1
            by_state[row, first + 3] = w0 * J[0, 3] + w1 * J[1, 3]
            a, b, d = _turned_back(cameras.R_rig_camera, c, a, b, d)
            by_landmark[row, 0], by_landmark[row, 1], by_landmark[row, 2] = a, b, d


@compiled()
def disparity_rows(
    cameras: Cameras, seen: PointRows, points: Array, residual: Array, by_state: Array, by_landmark: Array
) -> None:
    """Fill the third of an observation's three rows: what the grid should have measured, less what it did.

    That is the disparity there where the point falls on the grid; an observation without one keeps its zeros.
    """
    terms = cameras.bias.shape[1]
    J, t, s = np.empty((2, 4)), cameras.t_rig_camera, cameras.t_color_grid
    for m in range(len(seen.camera)):
        c, p, row, weight = seen.camera[m], seen.point[m], 3 * m + 2, seen.disparity_weight[m]
        if weight == 0.0:
            continue
        x, y, z = points[p, 0] - t[c, 0], points[p, 1] - t[c, 1], points[p, 2] - t[c, 2]
        x, y, z = _turned(cameras.R_rig_camera, c, x, y, z)
        X, Y, Z = _turned(cameras.R_color_grid, c, x - s[c, 0], y - s[c, 1], z - s[c, 2])
        if not (z > _MIN_DEPTH_M and Z > _MIN_DEPTH_M):
            residual[row] = _BEHIND
            continue
        u, v = _project(cameras.grid, c, X, Y, Z, J)
        s0, s1 = weight * seen.slope[m, 0], weight * seen.slope[m, 1]
        per_depth, factor = weight * cameras.raw_model[c, 0] / Z, 1.0
        for j in range(terms):
            factor += seen.basis[m, j] * cameras.bias[c, j]
            by_state[row, 6 + j] = -per_depth * seen.basis[m, j]
        read = s0 * (u - seen.grid_pixels[m, 0]) + s1 * (v - seen.grid_pixels[m, 1])
        residual[row] = weight * (cameras.raw_model[c, 1] - seen.disparity[m]) - per_depth * factor - read

        A = -(s0 * J[0, 0] + s1 * J[1, 0])  # by the point in the grid's frame
        B = -(s0 * J[0, 1] + s1 * J[1, 1])
        C = -(s0 * J[0, 2] + s1 * J[1, 2]) + per_depth * factor / Z
        _by_grid_turn(cameras.grid_turn_jacobian, c, A, B, C, X, Y, Z, by_state, row, 10 + terms)
        a, b, d = _turned_back(cameras.grid_turn, c, A, B, C)
        by_state[row, 13 + terms], by_state[row, 14 + terms], by_state[row, 15 + terms] = -a, -b, -d
        by_state[row, 16 + terms] = -s0 * (u - cameras.grid[c, 2]) - s1 * (v - cameras.grid[c, 3])
        by_state[row, 17 + terms], by_state[row, 18 + terms] = -s0, -s1

        a, b, d = _turned_back(cameras.R_color_grid, c, A, B, C)  # ... in the camera's
        _by_pose(a, b, d, x, y, z, by_state, row)
        a, b, d = _turned_back(cameras.R_rig_camera, c, a, b, d)
        by_landmark[row, 0], by_landmark[row, 1], by_landmark[row, 2] = a, b, d


@compiled()
def plane_rows(
    cameras: Cameras, seen: PlaneRows, planes: Array, residual: Array, by_state: Array, by_landmark: Array
) -> None:
    """One row an observation: the disparity of a plane π, π · X = 1, at a grid pixel, less what was measured.

    A plane moves into a frame (R, t) as Rᵀπ / (1 − π·t); on a ray r of that frame 1/z = π · r.
    `residual` (M,), `by_state` (M,S) and `by_landmark` (M,3) hold zeros before.
    """
    terms = cameras.bias.shape[1]
    t, s, k, bent = cameras.t_rig_camera, cameras.t_color_grid, cameras.grid, seen.ray_by_distorted
    for m in range(len(seen.camera)):
        c, p = seen.camera[m], seen.plane[m]
        side = 1.0 - (planes[p, 0] * t[c, 0] + planes[p, 1] * t[c, 1] + planes[p, 2] * t[c, 2])
        a, b, d = _turned(cameras.R_rig_camera, c, planes[p, 0], planes[p, 1], planes[p, 2])
        a, b, d = a / side, b / side, d / side
        grid_side = 1.0 - (a * s[c, 0] + b * s[c, 1] + d * s[c, 2])
        A, B, C = _turned(cameras.R_color_grid, c, a / grid_side, b / grid_side, d / grid_side)
        xd, yd = (seen.grid_pixels[m, 0] - k[c, 2]) / k[c, 0], (seen.grid_pixels[m, 1] - k[c, 3]) / k[c, 1]
        dx, dy = xd - seen.distorted[m, 0], yd - seen.distorted[m, 1]
        x = seen.rays[m, 0] + bent[m, 0, 0] * dx + bent[m, 0, 1] * dy
        y = seen.rays[m, 1] + bent[m, 1, 0] * dx + bent[m, 1, 1] * dy
        inverse_depth = A * x + B * y + C
        if not (side > 0.0 and grid_side > 0.0 and inverse_depth > 0.0):
            residual[m] = _BEHIND
            continue
        weight, factor = seen.disparity_weight[m] * cameras.raw_model[c, 0], 1.0
        for j in range(terms):
            factor += seen.basis[m, j] * cameras.bias[c, j]
            by_state[m, 6 + j] = -weight * inverse_depth * seen.basis[m, j]
        residual[m] = seen.disparity_weight[m] * (cameras.raw_model[c, 1] - seen.disparity[m])
        residual[m] -= weight * factor * inverse_depth

        P, Q, S = (
            -weight * factor * x,
            -weight * factor * y,
            -weight * factor,
        )  # by the plane in the grid's frame
        _by_grid_turn(cameras.grid_turn_jacobian, c, P, Q, S, A, B, C, by_state, m, 10 + terms)
        along = P * A + Q * B + S * C
        p0, p1, p2 = _turned_back(cameras.grid_turn, c, along * A, along * B, along * C)
        by_state[m, 13 + terms], by_state[m, 14 + terms], by_state[m, 15 + terms] = p0, p1, p2
        by_x = S * (A * bent[m, 0, 0] + B * bent[m, 1, 0])
        by_y = S * (A * bent[m, 0, 1] + B * bent[m, 1, 1])
        by_state[m, 16 + terms] = -(by_x * xd + by_y * yd)
        by_state[m, 17 + terms] = -by_x / k[c, 0]
        by_state[m, 18 + terms] = -by_y / k[c, 1]

        P, Q, S = _turned_back(cameras.R_color_grid, c, P, Q, S)  # ... in the camera's
        P, Q, S = P + along * s[c, 0], Q + along * s[c, 1], S + along * s[c, 2]
        P, Q, S = P / grid_side, Q / grid_side, S / grid_side
        _by_pose(P, Q, S, a, b, d, by_state, m)
        along = P * a + Q * b + S * d
        by_state[m, 3], by_state[m, 4], by_state[m, 5] = along * a, along * b, along * d
        P, Q, S = _turned_back(cameras.R_rig_camera, c, P, Q, S)  # ... in the rig's
        by_landmark[m, 0] = (P + along * t[c, 0]) / side
        by_landmark[m, 1] = (Q + along * t[c, 1]) / side
        by_landmark[m, 2] = (S + along * t[c, 2]) / side
