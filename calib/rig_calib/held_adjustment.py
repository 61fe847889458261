"""One camera adjusted while all others are held where a calibration has them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy.linalg

from rig_calib.alignment import align_frames
from rig_calib.bundle_adjustment import AdjustedCamera, Adjustment, adjust
from rig_calib.depth_model import DepthCorrection, DepthGrid, depth_grid
from rig_calib.observation_model import POSE, CameraState, Observations
from rig_calib.projection import from_pixels
from rig_calib.rig_adjustment import AdjustedRig, bias_sigma, model_sigmas
from rig_calib.rig_calibration import RigCalibration
from rig_calib.settings import CalibrationSettings
from rig_calib.view import CameraView
from rig_protocol.poses import Pose, transform_points

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

# So stiff a prior lets a held camera move less than a thousandth of its uncertainty.
_HELD_SIGMA = np.full(6, 1e-5)
# What a calibration leaves open of a depth bias, as a share of the prior: 0.5 of the scale, less of the
# shapes (joint adjustment of one frame of a rendered room).
_BIAS_LEFT = 0.5
# A direction that nothing says anything about gets this information, 10 rad or 10 m, and no error.
_VAGUE_INFORMATION = 1e-2


@dataclass(frozen=True, slots=True, eq=False)
class HeldAdjustment:
    """The free camera's pose and depth correction, with the others exactly where they were.

    `covariance` (6,6) takes the others' poses for granted; `sway` (6,6N) is how the pose follows errors of
    the N cameras `held`: δ = sway · (δ_1, ..., δ_N) + what `covariance` describes.
    """

    T_rig_camera: Pose
    correction: DepthCorrection | None
    covariance: Array
    held: tuple[int, ...]
    sway: Array


def adjust_held(
    rig: AdjustedRig,
    views: Mapping[int, CameraView],
    known: RigCalibration,
    camera_id: int,
    settings: CalibrationSettings,
) -> HeldAdjustment:
    """Adjust one camera of a solved `rig`, whose other cameras all have a pose in `known`, on its scene."""
    order = rig.scene.cameras
    others = tuple(c for c in order if c != camera_id)
    T = align_frames({c: rig.poses[c] for c in others}, known.poses)
    start = {c: known.poses[c] for c in others} | {camera_id: T @ rig.poses[camera_id]}
    trusted = {c: known.camera(c) for c in others}
    corrections = {c: camera.depth_correction for c, camera in trusted.items() if camera is not None}
    grids = {c: depth_grid(views[c].model, views[c].depth_frame) for c in order}
    cameras = [
        _adjusted_camera(views[c], grids[c], start[c], c != camera_id, corrections.get(c), settings)
        for c in order
    ]
    seen = _corrected(rig.scene.observations, [grids[c] for c in order], [corrections.get(c) for c in order])
    result = adjust(cameras, transform_points(T, rig.adjustment.points), seen)
    row = order.index(camera_id)
    covariance, sway = _uncertainty(result, row, len(order))
    state = result.states[row]
    correction = DepthCorrection(tuple(state.bias.tolist())) if len(state.bias) else None
    return HeldAdjustment(state.T_rig_camera, correction, covariance, others, sway)


def _adjusted_camera(
    view: CameraView,
    grid: DepthGrid,
    start: Pose,
    held: bool,
    correction: DepthCorrection | None,
    settings: CalibrationSettings,
) -> AdjustedCamera:
    """A camera of the problem; where a depth correction was applied, less bias than the prior's is left."""
    intrinsics_sigma, grid_pose_sigma, grid_intrinsics_sigma = model_sigmas(view)
    return AdjustedCamera(
        color=view.model.color,
        grid=grid,
        start=CameraState(start, np.zeros(settings.bias_terms)),
        bias_sigma=bias_sigma(grid, settings) * (1.0 if correction is None else _BIAS_LEFT),
        intrinsics_sigma=intrinsics_sigma,
        grid_pose_sigma=grid_pose_sigma,
        grid_intrinsics_sigma=grid_intrinsics_sigma,
        T_prior=start if held else None,
        pose_sigma=_HELD_SIGMA if held else None,
    )


def _corrected(
    seen: Observations, grids: Sequence[DepthGrid], corrections: Sequence[DepthCorrection | None]
) -> Observations:
    """Observations with the disparities that corrected depth has: offset − d is divided by the factor."""
    factor, offset = np.ones(len(seen)), np.zeros(len(seen))
    for camera, (grid, correction) in enumerate(zip(grids, corrections, strict=True)):
        rows = np.flatnonzero(seen.camera == camera)
        offset[rows] = grid.raw_model.offset
        if correction is not None:
            factor[rows] = correction.factor(*from_pixels(grid.intrinsics, seen.grid_pixels[rows]).T)
    return replace(
        seen,
        disparity=offset - (offset - seen.disparity) / factor,
        slope=seen.slope / factor[:, None],
        disparity_sigma=seen.disparity_sigma / factor,
    )


def _uncertainty(result: Adjustment, row: int, count: int) -> tuple[Array, Array]:
    """Of the free camera's pose: covariance (6,6) with all poses but its own fixed, sway (6,6N) with them.

    Of the normal equations [[A, B], [Bᵀ, D]] of what is free and of the held poses: A⁻¹ and −A⁻¹B.
    """
    size = len(result.normal) // count
    pose = np.arange(count * size).reshape(count, size)[:, POSE]
    held = np.delete(pose, row, axis=0).ravel()
    free = np.setdiff1d(np.arange(count * size), held)
    A = result.normal[np.ix_(free, free)] + _VAGUE_INFORMATION * np.eye(len(free))
    own = np.searchsorted(free, pose[row])
    solved = scipy.linalg.solve(A, np.eye(len(free))[:, own], assume_a="pos")
    return np.asarray(solved[own]), np.asarray(-solved.T @ result.normal[np.ix_(free, held)])
