"""What a camera should have measured of a landmark, and the derivatives of the difference.

A camera's state is its pose T_rig_camera and what is wrong with its factory model: its depth bias (the
coefficients of `DepthCorrection`), its colour intrinsics, the pose of its depth grid and that one's
intrinsics. A landmark is a point, observed by its pixel and the disparity there, or a plane, observed by
disparities.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DepthGrid, depth_basis
from rig_calib.observation_kernels import Cameras, PlaneRows, PointRows
from rig_calib.projection import distortion_inverse, from_pixels, undistort_pixels
from rig_calib.rotations import right_jacobians, rotation_matrices
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import Pose

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

POSE = slice(0, 6)
"""Where the pose stands in a camera's state: rotation vector (rad), translation (m), T · Exp(δ)."""
INTRINSIC_TERMS, GRID_POSE_TERMS, GRID_INTRINSIC_TERMS = 4, 6, 3


@dataclass(frozen=True, slots=True, eq=False)
class CameraState:
    """What the adjustment estimates of one camera; zeros are the factory model.

    `bias` (B,): coefficients of `DepthCorrection`. `intrinsics`: (log focal scale, Δcx, Δcy, Δk1) of the
    colour camera. `grid_pose`: rotation vector and translation on the right of T_color_grid.
    `grid_intrinsics`: (log focal scale, Δcx, Δcy) of the grid.
    """

    T_rig_camera: Pose
    bias: Array
    intrinsics: Array = field(default_factory=lambda: np.zeros(INTRINSIC_TERMS))
    grid_pose: Array = field(default_factory=lambda: np.zeros(GRID_POSE_TERMS))
    grid_intrinsics: Array = field(default_factory=lambda: np.zeros(GRID_INTRINSIC_TERMS))

    def beside_pose(self) -> Array:
        """All but the pose (S−6,), in the order of the state's columns."""
        return np.concatenate([self.bias, self.intrinsics, self.grid_pose, self.grid_intrinsics])

    @classmethod
    def from_columns(cls, T_rig_camera: Pose, beside_pose: Array) -> "CameraState":
        """The state from a pose and `beside_pose` (S−6,)."""
        ends = np.cumsum([GRID_INTRINSIC_TERMS, GRID_POSE_TERMS, INTRINSIC_TERMS])[::-1]
        return cls(T_rig_camera, *(part.copy() for part in np.split(beside_pose, len(beside_pose) - ends)))


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """M observations; `camera` (M,) and `point` (M,) index the problem's cameras and points.

    The residual of `pixels` (M,2) is `pixel_whitener` (M,2,2) times the difference in pixels: I/σ for a
    keypoint, of rank one for an edge, zero for none. `disparity` (M,), NaN = none, with its `slope` (M,2)
    around `grid_pixels` (M,2) and `disparity_sigma` (M,).
    """

    camera: Index
    point: Index
    pixels: Array
    pixel_whitener: Array
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

    @property
    def pixel_sigma(self) -> Array:
        """Standard deviations (M,) of pixels in directions in which they are known; infinite if in none."""
        information, full = self._pixel_information()
        directions, unknown = np.where(full, 2.0, 1.0), np.full(len(self), np.inf)
        variance = np.divide(directions, information, out=unknown, where=information > 0.0)
        return np.asarray(np.sqrt(variance))

    def pixel_error(self, residuals: Array) -> Array:
        """Pixels (M,2) that whitened residuals (M,2) stand for; zero across what was not measured."""
        W = self.pixel_whitener
        information, full = self._pixel_information()
        adjugate = W[:, (0, 1), (0, 1)].sum(axis=1)[:, None, None] * np.eye(2) - W
        pseudo_inverse = np.where(full[:, None, None], adjugate, W.transpose(0, 2, 1))
        by = np.where(full, _determinant(W), np.where(information > 0.0, information, 1.0))
        return np.asarray(np.einsum("mij,mj->mi", pseudo_inverse, residuals) / by[:, None])

    def _pixel_information(self) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Sum (M,) of what is known of a pixel over its directions, and whether that is both."""
        W = self.pixel_whitener
        information = np.asarray(np.einsum("mij,mij->m", W, W))
        return information, np.abs(_determinant(W)) > 1e-6 * information


@dataclass(frozen=True, slots=True, eq=False)
class PlaneObservations:
    """M disparities that cameras measured of shared planes at `grid_pixels` (M,2), thinned to be independent.

    `camera` (M,) and `plane` (M,) index the problem's cameras and planes.
    """

    camera: Index
    plane: Index
    grid_pixels: Array
    disparity: Array
    disparity_sigma: Array

    def __len__(self) -> int:
        """How many observations there are."""
        return len(self.camera)

    def select(self, keep: npt.NDArray[np.bool_] | Index) -> "PlaneObservations":
        """The observations that a mask or an index names."""
        return PlaneObservations(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))

    def renumbered(self, number: Index) -> "PlaneObservations":
        """The observations of planes that have other numbers (K,) now."""
        return replace(self, plane=number[self.plane])

    @classmethod
    def none(cls) -> "PlaneObservations":
        """No observations."""
        nothing = np.empty(0, dtype=np.intp)
        return cls(nothing, nothing, np.empty((0, 2)), np.empty(0), np.empty(0))


def isotropic_whitener(sigma: Array) -> Array:
    """Whiteners (M,2,2) of pixels known alike in all directions; `sigma` (M,) in pixels."""
    return np.eye(2) / np.asarray(sigma)[:, None, None]


@dataclass(frozen=True, slots=True, eq=False)
class FactoryModels:
    """The models of C cameras before anything is adjusted; intrinsics (C,9) as `Cameras` has them."""

    color: Array
    grid: Array
    T_color_grid: Array
    raw_model: Array
    grids: tuple[DepthGrid, ...]
    bias_terms: int

    @property
    def state_size(self) -> int:
        """Columns of a camera's state."""
        return 6 + self.bias_terms + INTRINSIC_TERMS + GRID_POSE_TERMS + GRID_INTRINSIC_TERMS

    @classmethod
    def of(cls, color: Sequence[Intrinsics], grids: Sequence[DepthGrid], bias_terms: int) -> "FactoryModels":
        """From one colour camera and one grid a camera."""
        return cls(
            color=np.array([intrinsics_row(intrinsics) for intrinsics in color]),
            grid=np.array([intrinsics_row(grid.intrinsics) for grid in grids]),
            T_color_grid=np.array([grid.T_color_grid for grid in grids], dtype=np.float64),
            raw_model=np.array([(grid.raw_model.numerator_m, grid.raw_model.offset) for grid in grids]),
            grids=tuple(grids),
            bias_terms=bias_terms,
        )

    def with_states(self, T_rig_camera: Array, beside_pose: Array) -> Cameras:
        """The cameras with poses (C,4,4) and states beside them (C,S−6) applied."""
        bias, intrinsics, grid_pose, grid_intrinsics = np.split(
            beside_pose, self.bias_terms + np.cumsum([0, INTRINSIC_TERMS, GRID_POSE_TERMS]), axis=1
        )
        color, grid = self.color.copy(), self.grid.copy()
        for adjusted, change in ((color, intrinsics), (grid, grid_intrinsics)):
            adjusted[:, :2] *= np.exp(change[:, :1])
            adjusted[:, 2 : 1 + change.shape[1]] += change[:, 1:]
        turn = rotation_matrices(grid_pose[:, :3])
        R, t = self.T_color_grid[:, :3, :3], self.T_color_grid[:, :3, 3]
        return Cameras(
            R_rig_camera=np.ascontiguousarray(T_rig_camera[:, :3, :3]),
            t_rig_camera=np.ascontiguousarray(T_rig_camera[:, :3, 3]),
            color=color,
            R_color_grid=R @ turn,
            t_color_grid=t + (R @ grid_pose[:, 3:, None])[..., 0],
            grid=grid,
            raw_model=self.raw_model,
            bias=np.ascontiguousarray(bias),
            grid_turn=turn,
            grid_turn_jacobian=right_jacobians(grid_pose[:, :3]),
        )

    def point_rows(self, seen: Observations) -> PointRows:
        """Observations as the compiled loops take them."""
        known = np.isfinite(seen.disparity)
        grid_pixels = np.where(known[:, None], seen.grid_pixels, 0.0)
        return PointRows(
            camera=seen.camera,
            point=seen.point,
            pixels=seen.pixels,
            whitener=np.ascontiguousarray(seen.pixel_whitener),
            disparity=np.where(known, seen.disparity, 0.0),
            slope=np.where(known[:, None], seen.slope, 0.0),
            grid_pixels=grid_pixels,
            disparity_weight=np.divide(1.0, seen.disparity_sigma, out=np.zeros(len(seen)), where=known),
            basis=self._basis(seen.camera, grid_pixels),
        )

    def plane_rows(self, seen: PlaneObservations) -> PlaneRows:
        """Observations as the compiled loops take them."""
        distorted, rays, by_distorted = (
            np.empty((len(seen), 2)),
            np.empty((len(seen), 2)),
            np.empty((len(seen), 2, 2)),
        )
        for c in np.unique(seen.camera):
            here, intrinsics = seen.camera == c, self.grids[c].intrinsics
            distorted[here] = from_pixels(intrinsics, seen.grid_pixels[here])
            rays[here] = undistort_pixels(intrinsics, seen.grid_pixels[here])
            by_distorted[here] = distortion_inverse(intrinsics, rays[here])
        return PlaneRows(
            camera=seen.camera,
            plane=seen.plane,
            disparity=seen.disparity,
            disparity_weight=1.0 / seen.disparity_sigma,
            basis=self._basis(seen.camera, seen.grid_pixels),
            grid_pixels=seen.grid_pixels,
            distorted=distorted,
            rays=rays,
            ray_by_distorted=by_distorted,
        )

    def _basis(self, camera: Index, grid_pixels: Array) -> Array:
        """Basis (M,B) of the depth bias at grid pixels (M,2)."""
        fx, fy, cx, cy = self.grid[camera, :4].T
        x, y = (grid_pixels[:, 0] - cx) / fx, (grid_pixels[:, 1] - cy) / fy
        return depth_basis(x, y, self.bias_terms)


def adjusted_intrinsics(color: Intrinsics, state: Array) -> Intrinsics:
    """Colour intrinsics with a camera's intrinsic state applied."""
    scale = float(np.exp(state[0]))
    k1, k2, p1, p2, k3 = color.dist
    return replace(
        color,
        fx=color.fx * scale,
        fy=color.fy * scale,
        cx=color.cx + float(state[1]),
        cy=color.cy + float(state[2]),
        dist=(k1 + float(state[3]), k2, p1, p2, k3),
    )


def _determinant(W: Array) -> Array:
    return np.asarray(W[:, 0, 0] * W[:, 1, 1] - W[:, 0, 1] * W[:, 1, 0])


def intrinsics_row(intrinsics: Intrinsics) -> tuple[float, ...]:
    """The nine numbers of a camera that compiled loops take."""
    return (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy, *intrinsics.dist)
