"""Disparity at keypoints: sub-pixel, from raw measurements, and none where the surface is not smooth.

A keypoint lies on a ray of the colour camera. Where that ray meets what the depth camera saw is found by
following the ray; there a plane (linear in disparity) is fitted to a window of measurements.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DISPARITY_SIGMA, DepthGrid, depth_of_disparity
from rig_calib.projection import project, undistort_pixels
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import inverse

Array = npt.NDArray[np.float64]

# Along the ray: the 25 mm between the cameras move the pixel by 29 px at 0.5 m, and each step divides
# what is left by more than three on any surface less steep than 75 degrees.
_STEPS = 6
_SETTLED_PX = 0.5
_HALF_WINDOWS_PX = (8, 5, 3)  # widest first: more measurements, if one plane explains them
_MIN_FILLED = 0.6  # of a window
# One plane explains a window when residuals look like noise: RMS and worst, in standard deviations.
_MAX_RMS_SIGMAS, _MAX_WORST_SIGMAS = 1.6, 5.0
# The noise correlates over the sensor's 9×7 window, so that a window averages few independent values.
_CORRELATION_PX = 4.0
_FROZEN_SHARE = 0.5  # of the noise's variance is the same in every frame


@dataclass(frozen=True, slots=True, eq=False)
class KeypointDepth:
    """Disparity at N keypoints, all NaN where there is none.

    `disparity` (N,), its gradient `slope` (N,2) per pixel of the depth grid, the place `grid_pixels` (N,2)
    where it was read, and `sigma` (N,): the standard deviation of `disparity`, raw steps.
    """

    disparity: Array
    slope: Array
    grid_pixels: Array
    sigma: Array

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        """(N,) where there is a disparity."""
        return np.isfinite(self.disparity)

    def select(self, keep: npt.NDArray[np.bool_]) -> "KeypointDepth":
        """The keypoints that a mask names."""
        return KeypointDepth(
            self.disparity[keep], self.slope[keep], self.grid_pixels[keep], self.sigma[keep]
        )


def mean_disparity(images: Sequence[Array]) -> Array:
    """Mean (H,W) over frames of what lies within three standard deviations of the median; NaN = none.

    A pixel counts when at least half of the frames have it.
    """
    if len(images) == 1:
        return images[0]
    stack = np.stack(images)
    enough = np.isfinite(stack).sum(axis=0) * 2 >= len(images)
    middle = np.full(stack.shape[1:], np.nan)
    middle[enough] = np.nanmedian(stack[:, enough], axis=0)
    stack[~(np.abs(stack - middle) <= 3.0 * DISPARITY_SIGMA * np.sqrt(2.0))] = np.nan
    count = np.isfinite(stack).sum(axis=0)
    return np.where(count > 0, np.nansum(stack, axis=0) / np.maximum(count, 1), np.nan)


def keypoint_depth(
    color: Intrinsics, grid: DepthGrid, disparity: Array, pixels: Array, frames: int = 1
) -> KeypointDepth:
    """Disparity (H,W) of the grid at colour pixels (N,2); `frames` is how many were averaged."""
    at = _follow_rays(color, grid, disparity, pixels)
    n = len(pixels)
    value, slope, sigma = np.full(n, np.nan), np.full((n, 2), np.nan), np.full(n, np.nan)
    for half in _HALF_WINDOWS_PX:
        open_ = np.flatnonzero(np.isfinite(at[:, 0]) & np.isnan(value))
        plane, good = _fit_planes(disparity, at[open_], half)
        chosen = open_[good]
        value[chosen], slope[chosen] = plane[good, 0], plane[good, 1:]
        sigma[chosen] = _sigma(half, frames)
    at[np.isnan(value)] = np.nan
    return KeypointDepth(value, slope, at, sigma)


def keypoint_points(color: Intrinsics, grid: DepthGrid, pixels: Array, depth: KeypointDepth) -> Array:
    """Points (N,3) in the colour camera: on the keypoint's ray, as deep as the depth says; NaN = none."""
    rays = np.column_stack([undistort_pixels(color, pixels), np.ones(len(pixels))])
    return rays * _ray_length(grid, rays, depth_of_disparity(grid.raw_model, depth.disparity))[:, None]


def _follow_rays(color: Intrinsics, grid: DepthGrid, disparity: Array, pixels: Array) -> Array:
    """Where on the grid (N,2) each colour pixel's ray meets the surface; NaN where that does not settle."""
    rays = np.column_stack([undistort_pixels(color, pixels), np.ones(len(pixels))])
    T_grid_color = inverse(grid.T_color_grid)
    known = np.isfinite(disparity)
    if not known.any():
        return np.full((len(pixels), 2), np.nan)
    depth_m = np.full(len(pixels), _middle_depth_m(grid, disparity[known]))
    at = last = np.full((len(pixels), 2), np.nan)
    for _ in range(_STEPS):
        points = rays * _ray_length(grid, rays, depth_m)[:, None]
        last, at = at, project(grid.intrinsics, points @ T_grid_color[:3, :3].T + T_grid_color[:3, 3])
        seen = _window_median(disparity, at)
        depth_m = np.where(np.isnan(seen), depth_m, depth_of_disparity(grid.raw_model, seen))
    settled = np.abs(at - last).max(axis=1) < _SETTLED_PX
    return np.where(settled[:, None], at, np.nan)


def _middle_depth_m(grid: DepthGrid, disparity: Array) -> float:
    return float(np.median(depth_of_disparity(grid.raw_model, disparity)))


def _ray_length(grid: DepthGrid, rays: Array, depth_m: Array) -> Array:
    """Scale s (N,) for which the point s·ray has the given depth along the grid's axis."""
    axis, offset = inverse(grid.T_color_grid)[2, :3], inverse(grid.T_color_grid)[2, 3]
    return np.asarray((depth_m - offset) / (rays @ axis))


def _window(disparity: Array, at: Array, half: int) -> tuple[Array, Array, Array]:
    """Values (N,W,W) around the pixels nearest to `at`, and their columns and rows relative to `at`."""
    height, width = disparity.shape
    centre = np.rint(np.nan_to_num(at)).astype(np.intp)
    offsets = np.arange(-half, half + 1)
    columns = centre[:, 0, None] + offsets
    rows = centre[:, 1, None] + offsets
    outside_columns, outside_rows = (columns < 0) | (columns >= width), (rows < 0) | (rows >= height)
    values = disparity[rows.clip(0, height - 1)[:, :, None], columns.clip(0, width - 1)[:, None, :]]
    values[outside_rows[:, :, None] | outside_columns[:, None, :]] = np.nan
    return values, columns - at[:, :1], rows - at[:, 1:]


def _window_median(disparity: Array, at: Array) -> Array:
    values = _window(disparity, at, 1)[0].reshape(len(at), 9)
    out = np.full(len(at), np.nan)
    some = np.isfinite(values).any(axis=1)
    out[some] = np.nanmedian(values[some], axis=1)
    return out


def _fit_planes(disparity: Array, at: Array, half: int) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Least-squares d = a + b·Δcolumn + c·Δrow in each window: (N,3), and where that explains the window."""
    values, columns, rows = _window(disparity, at, half)
    n, side = len(at), 2 * half + 1
    filled = np.isfinite(values).reshape(n, side * side)
    basis = np.stack(np.broadcast_arrays(1.0, columns[:, None, :], rows[:, :, None]), axis=-1)
    basis = basis.reshape(n, side * side, 3) * filled[..., None]
    values = np.where(filled, values.reshape(n, side * side), 0.0)
    enough = filled.mean(axis=1) >= _MIN_FILLED
    normal = np.einsum("nki,nkj->nij", basis, basis) + 1e-9 * np.eye(3)
    plane = np.linalg.solve(normal, np.einsum("nki,nk->ni", basis, values)[..., None])[..., 0]
    residual = values - np.einsum("nki,ni->nk", basis, plane)
    rms = np.sqrt((residual**2).sum(axis=1) / np.maximum(filled.sum(axis=1), 1))
    worst = np.abs(residual).max(axis=1)
    limit_rms, limit_worst = _MAX_RMS_SIGMAS * DISPARITY_SIGMA, _MAX_WORST_SIGMAS * DISPARITY_SIGMA
    return plane, enough & (rms < limit_rms) & (worst < limit_worst)


def _sigma(half: int, frames: int) -> float:
    """Standard deviation of a plane's value at the middle of its window, averaged over frames."""
    independent = max(1.0, ((2 * half + 1) / (2.0 * _CORRELATION_PX)) ** 2)
    share = _FROZEN_SHARE + (1.0 - _FROZEN_SHARE) / frames
    return float(DISPARITY_SIGMA * np.sqrt(share / independent))
