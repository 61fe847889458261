"""What an edge rests on, kept for people who want to see it: its matches, and by how much they miss."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DepthCorrection, depth_of_disparity, disparity_of_depth
from rig_calib.edges import Edge
from rig_calib.keypoint_depth import keypoint_points
from rig_calib.observed_camera import ObservedCamera
from rig_calib.projection import from_pixels, project
from rig_calib.registration import Side
from rig_calib.rig_adjustment import AdjustedRig
from rig_calib.standardised import StandardisedResiduals
from rig_protocol.poses import Pose, inverse, transform_points

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class EdgeEvidence:
    """Matches between the colour images of cameras i and j in one frame, and what became of them.

    `pixels_i`, `pixels_j`: (N,2) in the image as delivered (distorted, pixel centres at integers).
    `inlier`: (N,) bool, kept by the final estimate. `residual_px`: (N,) reprojection error of each match
    under the final poses, NaN where it has none (no depth). `frame` indexes `CameraView.color`.
    `pixel_errors` (K,), `disparity_errors` (L,): standardised residuals of the adjustment, empty without one.
    """

    i: int
    j: int
    pixels_i: npt.NDArray[np.float64]
    pixels_j: npt.NDArray[np.float64]
    inlier: npt.NDArray[np.bool_]
    residual_px: npt.NDArray[np.float64]
    frame: int = 0
    pixel_errors: npt.NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    disparity_errors: npt.NDArray[np.float64] = field(default_factory=lambda: np.empty(0))


def corrected(camera: ObservedCamera, correction: DepthCorrection | None) -> ObservedCamera:
    """The camera with its depth corrected."""
    if correction is None:
        return camera
    x, y = from_pixels(camera.grid.intrinsics, camera.depth.grid_pixels).T
    model = camera.grid.raw_model
    depth_m = depth_of_disparity(model, camera.depth.disparity) * correction.factor(x, y)
    depth = replace(camera.depth, disparity=disparity_of_depth(model, depth_m))
    points = keypoint_points(camera.view.model.color, camera.grid, camera.keypoints.pixels, depth)
    return replace(camera, points=points)


def edge_evidence(
    cameras: Mapping[int, ObservedCamera],
    edges: Sequence[Edge],
    poses: Mapping[int, Pose],
    rig: AdjustedRig | None = None,
) -> list[EdgeEvidence]:
    """What the report draws of every edge with matches; residuals where both cameras have a pose."""
    residuals = None if rig is None else StandardisedResiduals.of(rig)
    return [_evidence(cameras, edge, poses, residuals) for edge in edges if len(edge.matches)]


def _evidence(
    cameras: Mapping[int, ObservedCamera],
    edge: Edge,
    poses: Mapping[int, Pose],
    residuals: StandardisedResiduals | None,
) -> EdgeEvidence:
    i, j = _sides(cameras, edge)
    residual = np.full(len(edge.matches), np.nan)
    if edge.i in poses and edge.j in poses:
        T_i_j = inverse(poses[edge.i]) @ poses[edge.j]
        residual = np.fmax(_miss_px(T_i_j, j, i), _miss_px(inverse(T_i_j), i, j))
    evidence = EdgeEvidence(edge.i, edge.j, i.pixels, j.pixels, edge.inlier, residual)
    if residuals is None or edge.reason is not None:
        return evidence
    pixel, disparity = residuals.of_pair(*edge.pair)
    return replace(evidence, pixel_errors=pixel, disparity_errors=disparity)


def _miss_px(T: Pose, source: Side, target: Side) -> Array:
    """How far (N,) the source's points fall from the target's pixels; NaN without depth or behind it."""
    points = transform_points(T, source.points)
    points[~(points[:, 2] > 0.05)] = np.nan
    return np.asarray(np.linalg.norm(project(target.color, points) - target.pixels, axis=1))


def _sides(cameras: Mapping[int, ObservedCamera], edge: Edge) -> tuple[Side, Side]:
    return cameras[edge.i].side(edge.matches[:, 0]), cameras[edge.j].side(edge.matches[:, 1])
