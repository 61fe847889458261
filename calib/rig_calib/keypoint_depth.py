"""Disparity at keypoints: sub-pixel, from raw measurements, and none where the surface is not smooth.

A keypoint lies on a ray of the colour camera. Where that ray meets what the depth camera saw is found by
following the ray; there a plane (linear in disparity) is fitted to a window of measurements.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DISPARITY_SIGMA, DepthGrid, depth_of_disparity
from rig_calib.disparity_windows import fitted_planes, window_medians
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
# One plane explains a window when its residuals look like noise: their RMS, and the worst.
_MAX_RMS, _MAX_WORST = 1.6 * DISPARITY_SIGMA, 5.0 * DISPARITY_SIGMA
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
        return KeypointDepth(self.disparity[keep], self.slope[keep], self.grid_pixels[keep], self.sigma[keep])


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
    planes, sigma = np.full((len(pixels), 3), np.nan), np.full(len(pixels), np.nan)
    for half in _HALF_WINDOWS_PX:
        fitted_planes(disparity, at, half, _MIN_FILLED, _MAX_RMS, _MAX_WORST, planes)
        sigma[np.isnan(sigma) & np.isfinite(planes[:, 0])] = window_sigma(half, frames)
    at[np.isnan(planes[:, 0])] = np.nan
    return KeypointDepth(planes[:, 0], planes[:, 1:], at, sigma)


def on_one_plane(disparity: Array, grid_pixels: Array, half_px: int, filled: float) -> npt.NDArray[np.bool_]:
    """(N,) whether one plane explains the window around each place, nothing missing but a share."""
    planes = np.full((len(grid_pixels), 3), np.nan)
    fitted_planes(disparity, grid_pixels, half_px, filled, _MAX_RMS, _MAX_WORST, planes)
    return np.asarray(np.isfinite(planes[:, 0]))


def keypoint_points(color: Intrinsics, grid: DepthGrid, pixels: Array, depth: KeypointDepth) -> Array:
    """Points (N,3) in the colour camera: on the keypoint's ray, as deep as the depth says; NaN = none."""
    rays = np.column_stack([undistort_pixels(color, pixels), np.ones(len(pixels))])
    return rays * _ray_length(grid, rays, depth_of_disparity(grid.raw_model, depth.disparity))[:, None]


def _follow_rays(color: Intrinsics, grid: DepthGrid, disparity: Array, pixels: Array) -> Array:
    """Where on the grid (N,2) each colour pixel's ray meets the surface; NaN where that does not settle."""
    rays = np.column_stack([undistort_pixels(color, pixels), np.ones(len(pixels))])
    T_grid_color = inverse(grid.T_color_grid)
    depth_m = np.full(len(pixels), _middle_depth_m(grid, disparity))
    at = last = np.full((len(pixels), 2), np.nan)
    for _ in range(_STEPS):
        points = rays * _ray_length(grid, rays, depth_m)[:, None]
        last, at = at, project(grid.intrinsics, points @ T_grid_color[:3, :3].T + T_grid_color[:3, 3])
        seen = window_medians(disparity, at)
        depth_m = np.where(np.isnan(seen), depth_m, depth_of_disparity(grid.raw_model, seen))
    settled = np.abs(at - last).max(axis=1) < _SETTLED_PX
    return np.where(settled[:, None], at, np.nan)


def _middle_depth_m(grid: DepthGrid, disparity: Array) -> float:
    """Where to start: the median depth of every fourth pixel both ways, or of all pixels; NaN without any."""
    for sample in (disparity[::4, ::4], disparity):
        known = sample[np.isfinite(sample)]
        if len(known):
            return float(np.median(depth_of_disparity(grid.raw_model, known)))
    return np.nan


def _ray_length(grid: DepthGrid, rays: Array, depth_m: Array) -> Array:
    """Scale s (N,) for which the point s·ray has the given depth along the grid's axis."""
    axis, offset = inverse(grid.T_color_grid)[2, :3], inverse(grid.T_color_grid)[2, 3]
    return np.asarray((depth_m - offset) / (rays @ axis))


def window_sigma(half: int, frames: int) -> float:
    """Standard deviation of a plane's value at the middle of its window, averaged over frames."""
    independent = max(1.0, ((2 * half + 1) / (2.0 * _CORRELATION_PX)) ** 2)
    share = _FROZEN_SHARE + (1.0 - _FROZEN_SHARE) / frames
    return float(DISPARITY_SIGMA * np.sqrt(share / independent))
