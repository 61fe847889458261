"""What a camera should have measured of a point, and the derivatives of the difference.

A camera's state is its pose T_rig_camera, its depth bias (the coefficients of `DepthCorrection`) and its
colour intrinsics (relative focal length, principal point in pixels). An observation is a keypoint's pixel
and, where there is one, the disparity there.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DepthGrid, depth_basis
from rig_calib.projection import from_pixels, project, project_jacobian
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import Pose, hat, inverse, transform_points

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

POSE = slice(0, 6)
"""Where the pose stands in a camera's state: rotation vector (rad), translation (m), T · Exp(δ)."""
INTRINSIC_TERMS = 3
_MIN_DEPTH_M = 0.05

# A point without any disparity still lies in the room: its inverse depth is 0.5 ± 0.4 per metre.
_VAGUE_INVERSE_DEPTH, _VAGUE_INVERSE_DEPTH_SIGMA = 0.5, 0.4


@dataclass(frozen=True, slots=True, eq=False)
class CameraState:
    """What the adjustment estimates of one camera. `intrinsics`: (log focal scale, Δcx, Δcy)."""

    T_rig_camera: Pose
    bias: Array
    intrinsics: Array


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """M observations; `camera` (M,) and `point` (M,) index the problem's cameras and points.

    `pixels` (M,2) with `pixel_sigma` (M,); `disparity` (M,), NaN = none, with its `slope` (M,2) around
    `grid_pixels` (M,2) and `disparity_sigma` (M,).
    """

    camera: Index
    point: Index
    pixels: Array
    pixel_sigma: Array
    disparity: Array
    slope: Array
    grid_pixels: Array
    disparity_sigma: Array

    def __len__(self) -> int:
        """How many observations there are."""
        return len(self.camera)

    def select(self, keep: npt.NDArray[np.bool_] | Index) -> "Observations":
        """The observations that a mask or an index names."""
        return Observations(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


def adjusted_intrinsics(color: Intrinsics, state: Array) -> Intrinsics:
    """Colour intrinsics with a camera's intrinsic state applied."""
    scale = float(np.exp(state[0]))
    return replace(
        color,
        fx=color.fx * scale,
        fy=color.fy * scale,
        cx=color.cx + float(state[1]),
        cy=color.cy + float(state[2]),
    )


def residuals(
    color: Intrinsics, grid: DepthGrid, state: CameraState, points: Array, seen: Observations
) -> Array:
    """Whitened residuals (M,3) of one camera: column, row, disparity (0 where there is none).

    Infinite for a point that is not in front of the camera.
    `points` (M,3), rig frame, are those that `seen` observes, row by row.
    """
    in_camera = transform_points(inverse(state.T_rig_camera), points)
    out = np.zeros((len(seen), 3))
    out[:, :2] = project(adjusted_intrinsics(color, state.intrinsics), in_camera) - seen.pixels
    out[:, :2] /= seen.pixel_sigma[:, None]
    known = np.isfinite(seen.disparity)
    in_grid = transform_points(inverse(grid.T_color_grid), in_camera[known])
    measured = seen.disparity[known] + np.einsum(
        "mk,mk->m", seen.slope[known], project(grid.intrinsics, in_grid) - seen.grid_pixels[known]
    )
    factor = 1.0 + _bias_basis(grid, seen.grid_pixels[known], len(state.bias)) @ state.bias
    predicted = grid.raw_model.offset - grid.raw_model.numerator_m * factor / in_grid[:, 2]
    out[known, 2] = (predicted - measured) / seen.disparity_sigma[known]
    out[in_camera[:, 2] < _MIN_DEPTH_M] = np.inf
    return out


def jacobians(
    color: Intrinsics, grid: DepthGrid, state: CameraState, points: Array, seen: Observations
) -> tuple[Array, Array]:
    """Derivatives of `residuals`: by the camera's state (M,3,S) and by the points (M,3,3)."""
    in_camera = transform_points(inverse(state.T_rig_camera), points)
    terms = len(state.bias)
    by_position = np.zeros((len(seen), 3, 3))  # in the camera frame
    by_state = np.zeros((len(seen), 3, 6 + terms + INTRINSIC_TERMS))
    intrinsics = adjusted_intrinsics(color, state.intrinsics)
    weight = 1.0 / seen.pixel_sigma
    by_position[:, :2] = project_jacobian(intrinsics, in_camera) * weight[:, None, None]
    centre = (intrinsics.cx, intrinsics.cy)
    by_state[:, :2, 6 + terms] = (project(intrinsics, in_camera) - centre) * weight[:, None]
    by_state[:, 0, 7 + terms] = by_state[:, 1, 8 + terms] = weight

    known = np.isfinite(seen.disparity)
    by_position[known, 2], by_state[known, 2, 6 : 6 + terms] = _disparity_jacobian(
        grid, state.bias, in_camera[known], seen.select(known)
    )
    by_state[:, :, 0:3] = by_position @ hat(in_camera)
    by_state[:, :, 3:6] = -by_position
    return by_state, by_position @ state.T_rig_camera[:3, :3].T


def vague_disparity(grid: DepthGrid) -> tuple[float, float]:
    """Disparity and standard deviation that stand for "somewhere in the room"."""
    numerator, offset = grid.raw_model.numerator_m, grid.raw_model.offset
    return offset - numerator * _VAGUE_INVERSE_DEPTH, numerator * _VAGUE_INVERSE_DEPTH_SIGMA


def _disparity_jacobian(
    grid: DepthGrid, bias: Array, in_camera: Array, seen: Observations
) -> tuple[Array, Array]:
    """Of the whitened disparity residual: by the point in the camera frame (M,3) and by the bias (M,B)."""
    T_grid_color = inverse(grid.T_color_grid)
    in_grid = transform_points(T_grid_color, in_camera)
    basis = _bias_basis(grid, seen.grid_pixels, len(bias))
    per_depth = grid.raw_model.numerator_m / in_grid[:, 2]
    by_grid = -np.einsum("mk,mki->mi", seen.slope, project_jacobian(grid.intrinsics, in_grid))
    by_grid[:, 2] += per_depth * (1.0 + basis @ bias) / in_grid[:, 2]
    weight = 1.0 / seen.disparity_sigma[:, None]
    return by_grid @ T_grid_color[:3, :3] * weight, -basis * per_depth[:, None] * weight


def _bias_basis(grid: DepthGrid, grid_pixels: Array, terms: int) -> Array:
    x, y = from_pixels(grid.intrinsics, grid_pixels).T
    return depth_basis(x, y, terms) if terms else np.zeros((len(grid_pixels), 0))
