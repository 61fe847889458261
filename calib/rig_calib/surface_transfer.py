"""Where a pixel of one camera lies in another: through the plane that its depth camera measured there.

A plane is a vector π with π · X = 1 for its points X in the colour camera, so that the ray r = (x, y, 1)
meets it at depth 1/(π · r): what is linear in disparity stays linear.
"""

import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DepthCorrection, DepthGrid
from rig_calib.keypoint_depth import KeypointDepth
from rig_calib.projection import from_pixels, project, undistort_pixels
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import Pose, transform_points

Array = npt.NDArray[np.float64]

_NEAR_M = 0.05


def surface_planes(grid: DepthGrid, depth: KeypointDepth, correction: DepthCorrection | None) -> Array:
    """Planes π (N,3) in the colour camera around keypoints with depth; NaN rows where there is none."""
    model, camera = grid.raw_model, grid.intrinsics
    # 1/z = (offset − d)/numerator, and d is linear in the pixel.
    by_x = -depth.slope[:, 0] * camera.fx / model.numerator_m
    by_y = -depth.slope[:, 1] * camera.fy / model.numerator_m
    at = from_pixels(camera, depth.grid_pixels)
    inverse_z = (model.offset - depth.disparity) / model.numerator_m
    in_grid = np.column_stack([by_x, by_y, inverse_z - by_x * at[:, 0] - by_y * at[:, 1]])
    if correction is not None:
        in_grid /= correction.factor(at[:, 0], at[:, 1])[:, None]
    return transform_planes(grid.T_color_grid, in_grid)


def transform_planes(T_a_b: Pose, planes: Array) -> Array:
    """Planes π (N,3) of frame b in frame a: Rπ / (1 + Rπ · t)."""
    turned = planes @ T_a_b[:3, :3].T
    return np.asarray(turned / (1.0 + turned @ T_a_b[:3, 3])[:, None])


def transfer(
    source: Intrinsics, target: Intrinsics, T_target_source: Pose, planes: Array, pixels: Array
) -> Array:
    """Pixels (N,2) of the target at which the source's pixels (N,2) appear; NaN where that is nowhere."""
    rays = np.column_stack([undistort_pixels(source, pixels), np.ones(len(pixels))])
    depth_m = 1.0 / np.einsum("ni,ni->n", planes, rays)
    points = transform_points(T_target_source, rays * depth_m[:, None])
    points[~((points[:, 2] > _NEAR_M) & (depth_m > _NEAR_M))] = np.nan
    return project(target, points)


def transfer_affine(
    source: Intrinsics, target: Intrinsics, T_target_source: Pose, planes: Array, pixels: Array
) -> Array:
    """Derivative (N,2,2) of `transfer` by the source's pixels, by central differences of a pixel."""
    columns = []
    for step in np.eye(2):
        ahead = transfer(source, target, T_target_source, planes, pixels + step)
        behind = transfer(source, target, T_target_source, planes, pixels - step)
        columns.append(0.5 * (ahead - behind))
    return np.stack(columns, axis=2)
