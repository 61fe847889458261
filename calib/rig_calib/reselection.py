"""Matches looked at again under adjusted poses and depth: which agree, and by how much they miss."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DepthCorrection, depth_of_disparity, disparity_of_depth
from rig_calib.edges import Edge
from rig_calib.evidence import EdgeEvidence
from rig_calib.keypoint_depth import keypoint_points
from rig_calib.observed_camera import ObservedCamera
from rig_calib.projection import from_pixels, project
from rig_calib.registration import Side, Tolerance, agreeing
from rig_calib.rig_adjustment import AdjustedRig
from rig_calib.standardised import StandardisedResiduals
from rig_protocol.poses import Pose, inverse, transform_points

Array = npt.NDArray[np.float64]

# With depth bias estimated, a pair is allowed half the error of depth that it is allowed alone.
_TOLERANCE = Tolerance(pixels=6.0, inverse_depth=0.012, depth_scale=0.015)
_MIN_SHARE_KEPT = 1.0 / 3.0


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


def reselect(
    cameras: Mapping[int, ObservedCamera], edges: Sequence[Edge], poses: Mapping[int, Pose], min_inliers: int
) -> list[Edge]:
    """The edges with their matches judged by the rig's poses; `cameras` hold corrected depth.

    An edge that no longer has `min_inliers`, or not a third of what it had alone, is refused. One that was
    too weak alone keeps its reason.
    """
    return [_reselected(cameras, edge, poses, min_inliers) for edge in edges]


def edge_evidence(
    cameras: Mapping[int, ObservedCamera],
    edges: Sequence[Edge],
    poses: Mapping[int, Pose],
    rig: AdjustedRig | None = None,
) -> list[EdgeEvidence]:
    """What the report draws of every edge with matches; residuals where both cameras have a pose."""
    residuals = None if rig is None else StandardisedResiduals.of(rig)
    return [_evidence(cameras, edge, poses, residuals) for edge in edges if len(edge.matches)]


def _reselected(
    cameras: Mapping[int, ObservedCamera], edge: Edge, poses: Mapping[int, Pose], min_inliers: int
) -> Edge:
    if edge.reason is not None or edge.i not in poses or edge.j not in poses:
        return edge
    i, j = _sides(cameras, edge)
    inlier = agreeing(inverse(poses[edge.i]) @ poses[edge.j], i, j, _TOLERANCE)
    if inlier.sum() < max(min_inliers, edge.inlier.sum() * _MIN_SHARE_KEPT):
        return edge.refused(
            f"only {inlier.sum()} of its {edge.inlier.sum()} matches agree with the other edges"
        )
    return replace(edge, inlier=inlier)


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
