"""Cameras that no longer stand to each other as a calibration says."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from rig_calib.calibration import CalibrationResult, calibrate
from rig_calib.overlap import shared_regions
from rig_calib.rig_adjustment import AdjustedRig
from rig_calib.rig_calibration import RigCalibration
from rig_calib.settings import CalibrationSettings
from rig_calib.stages import Progress
from rig_calib.view import CameraView
from rig_protocol.poses import Pose, inverse, se3_log
from rig_protocol.rig_folder import RingDrawing

Pair = tuple[int, int]

# A mount may be off by several degrees and be found all the same.
_OVERLAP_MARGIN_DEG = 7.0
# Known poses enter a new calibration this loosely, so that its matches can contradict them.
_LOOSE = RingDrawing(tolerance_deg=3.0, tolerance_m=0.03)
_CONTRADICTION = 22.5  # 99.9 % of a squared normal error in six dimensions
_FLOOR = np.diag(np.repeat([np.deg2rad(0.05), 0.001], 3) ** 2)  # what no covariance holds: rolling shutters


def calibrate_around(
    camera: CameraView,
    place: Pose | None,
    others: Sequence[CameraView],
    known: RigCalibration,
    settings: CalibrationSettings,
    progress: Progress | None = None,
) -> CalibrationResult:
    """Calibrate one camera, about at `place` (None: anywhere), with those others that see what it sees.

    The others enter with their known poses, loosely.
    """
    moved = replace(camera, T_rig_nominal=place)
    near = [one for one in _standing(others, known) if place is None or _share_a_view(moved, one)]
    return calibrate([moved, *near], _LOOSE, settings, progress)


def contradictions(
    rig: AdjustedRig,
    camera: CameraView,
    others: Sequence[CameraView],
    known: RigCalibration,
    settings: CalibrationSettings,
) -> list[str]:
    """Sentences on what contradicts `known` in a `rig` that was calibrated around one camera.

    The cameras around it are compared through it. Those that contradict each other, and one that has none to
    be compared with, are looked at together with their own neighbours: one of these may accuse it.
    """
    names = {other.camera_id: other.name for other in others}
    around = [camera_id for camera_id in rig.poses if camera_id in names]
    through = {pair: told for pair in combinations(around, 2) if (told := _difference(pair, rig, known))}
    if len(around) > 1 and not through:
        return []
    accused = _accused(around, others, known, settings)
    if accused:
        return [
            f"camera {camera_id} ({names[camera_id]}) stands {told} from where the calibration has it, as "
            "its other neighbour sees it: it has moved, too; calibrate the whole rig"
            for camera_id, told in accused.items()
        ]
    return [
        f"cameras {i} ({names[i]}) and {j} ({names[j]}), both seen from {camera.name}, stand {told} "
        "from where the calibration has them: one of them has moved, too, or matches are false; calibrate "
        "the whole rig"
        for (i, j), told in through.items()
    ]


def _accused(
    around: Sequence[int], others: Sequence[CameraView], known: RigCalibration, settings: CalibrationSettings
) -> dict[int, str]:
    """Cameras of `around` that a neighbour of theirs contradicts, and by how much."""
    accused: dict[int, str] = {}
    for view in others:
        if view.camera_id not in around:
            continue
        rest = [other for other in others if other is not view]
        rig = calibrate_around(view, known.poses[view.camera_id], rest, known, settings).rig
        if rig is None or view.camera_id not in rig.poses:
            continue
        neighbours = [camera_id for camera_id in rig.poses if camera_id != view.camera_id]
        told = [_difference((view.camera_id, neighbour), rig, known) for neighbour in neighbours]
        if any(told):
            accused[view.camera_id] = next(one for one in told if one is not None)
    return accused


def _difference(pair: Pair, rig: AdjustedRig, known: RigCalibration) -> str | None:
    """By how much a rig contradicts the known relative pose of two cameras; None when it does not."""
    T_i_j, covariance = rig.relative(*pair)
    before = inverse(known.poses[pair[0]]) @ known.poses[pair[1]]
    known_covariance = known.relative_covariance(*pair)
    total = covariance + _FLOOR + (0.0 if known_covariance is None else known_covariance)
    r = se3_log(inverse(before) @ T_i_j)
    if r @ np.linalg.solve(total, r) <= _CONTRADICTION:
        return None
    return f"{np.rad2deg(np.linalg.norm(r[:3])):.1f}° and {np.linalg.norm(r[3:]) * 1e3:.0f} mm"


def _standing(views: Sequence[CameraView], known: RigCalibration) -> list[CameraView]:
    return [replace(view, T_rig_nominal=known.poses[view.camera_id]) for view in views]


def _share_a_view(a: CameraView, b: CameraView) -> bool:
    models = {view.camera_id: view.model.color for view in (a, b)}
    poses = {view.camera_id: view.T_rig_nominal for view in (a, b)}
    return bool(shared_regions(models, poses, _OVERLAP_MARGIN_DEG))
