"""One camera of a calibrated rig found anew, for it was knocked or its mount was changed; the others stay.

The camera and those it shares a view with are calibrated as a small rig of their own. Its scene is adjusted
once more with every other camera held where the calibration has it.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import scipy.linalg

from rig_calib.calibration import CalibrationResult
from rig_calib.contradictions import calibrate_around, contradictions
from rig_calib.evidence import EdgeEvidence
from rig_calib.gate import MORE_MATCHES, far_from_drawing
from rig_calib.held_adjustment import HeldAdjustment, adjust_held
from rig_calib.loops import closing_cycle
from rig_calib.pose_graph import loop_error
from rig_calib.rig_calibration import CalibratedCamera, CalibratedEdge, LoopClosure, RigCalibration
from rig_calib.settings import CalibrationSettings
from rig_calib.stages import Progress
from rig_calib.uncertainty import PoseCovariance, weakest_direction
from rig_calib.view import CameraView
from rig_protocol.errors import ConfigurationError
from rig_protocol.poses import Pose, inverse
from rig_protocol.rig_folder import RingDrawing

Array = npt.NDArray[np.float64]


def recalibrate(
    views: Sequence[CameraView],
    known: RigCalibration,
    camera_id: int,
    ring: RingDrawing | None,
    settings: CalibrationSettings,
    progress: Progress | None = None,
) -> CalibrationResult:
    """Find one camera anew, also one that had no pose; what `known` says of the others stays bit by bit.

    Its covariance holds the others' uncertainty (without a joint covariance in `known`: as if they erred
    independently). `failures` tell when it finds no support, and when the cameras around it contradict
    `known` because another one has moved. `ring` is the drawing that a warning compares with.
    ConfigurationError for a camera without a view, one that defines the rig frame, and the method `paper`.
    """
    view = _view_of(camera_id, views, known, settings)
    others = [other for other in views if other.camera_id in known.poses.keys() - {camera_id}]
    drawn = known.rig_frame == "ring"
    place = known.poses.get(camera_id, view.T_rig_nominal if drawn else None)
    local = calibrate_around(view, place, others, known, settings, progress)
    if place is not None and not _found(local, view):  # it may be anywhere
        local = calibrate_around(view, None, others, known, settings, progress)
    if local.rig is None or not _found(local, view):
        return _unfound(local, known, view)
    held = adjust_held(local.rig, {one.camera_id: one for one in views}, known, camera_id, settings)
    edges = [edge for edge in local.calibration.edges if camera_id in (edge.i, edge.j)]
    failures = _unsupported(held, view, settings)
    failures += contradictions(local.rig, view, others, known, settings)
    warnings = _unused(edges) + _unconfirmed(edges, view)
    if drawn:
        warnings += far_from_drawing([view], {camera_id: held.T_rig_camera}, ring or RingDrawing())
    merged = _merged(known, _camera(held, known, view), held, edges)
    calibration = replace(
        merged,
        seconds=local.calibration.seconds,
        warnings=(*_not_about(camera_id, known.warnings), *warnings),
        failures=(*_not_about(camera_id, known.failures), *failures),
    )
    return CalibrationResult(calibration, _evidence(local, view), known.poses, local.rig)


def find_camera(word: str, known: RigCalibration, names: Mapping[int, str]) -> int:
    """The id of the camera that a user names, by id or else by name; ConfigurationError lists all there are.

    `names` are those of the rig, which may have cameras that the calibration could not place.
    """
    everyone = dict(names) | {camera.id: camera.name for camera in known.cameras}
    if word.isdecimal() and int(word) in everyone:  # whatever another camera is called
        return int(word)
    for camera_id, name in everyone.items():
        if word == name:
            return camera_id
    listed = ", ".join(f"{name} ({camera_id})" for camera_id, name in sorted(everyone.items()))
    raise ConfigurationError(f"no camera is called {word!r}; there are {listed}")


def _view_of(
    camera_id: int, views: Sequence[CameraView], known: RigCalibration, settings: CalibrationSettings
) -> CameraView:
    if settings.method != "joint":
        raise ConfigurationError("a single camera is recalibrated with method `joint` only")
    if known.rig_frame == f"camera {camera_id}":
        raise ConfigurationError(
            f"camera {camera_id} defines the frame of this calibration, so that its own pose cannot change: "
            "calibrate the whole rig"
        )
    for view in views:
        if view.camera_id == camera_id:
            return view
    raise ConfigurationError(
        f"camera {camera_id} is not in this capture, which holds {[view.camera_id for view in views]}"
    )


def _found(local: CalibrationResult, view: CameraView) -> bool:
    """Whether measurements place the camera, not the drawing alone."""
    if local.rig is None or view.camera_id not in local.calibration.poses:
        return False
    scene = local.rig.scene
    return bool((scene.observations.camera == scene.cameras.index(view.camera_id)).any())


def _unfound(local: CalibrationResult, known: RigCalibration, view: CameraView) -> CalibrationResult:
    """`known` as it was, and why the camera could not be found anew."""
    own = f"camera {view.camera_id} ("
    told = [text for text in local.calibration.failures if text.startswith(own)]
    told = told or [f"{own}{view.name}) shares no view with a camera of the calibration"]
    failures = (*_not_about(view.camera_id, known.failures), *told)
    calibration = replace(known, seconds=local.calibration.seconds, failures=failures)
    return CalibrationResult(calibration, _evidence(local, view), known.poses, None)


def _unsupported(held: HeldAdjustment, view: CameraView, settings: CalibrationSettings) -> list[str]:
    sigma_deg, sigma_m = weakest_direction(held.covariance)
    if sigma_deg <= settings.max_edge_sigma_deg and sigma_m <= settings.max_edge_sigma_m:
        return []
    known_to = f"{sigma_deg:.1f}° and {sigma_m * 1e3:.0f} mm"
    return [
        f"camera {view.camera_id} ({view.name}) is only known to {known_to} from its overlaps: {MORE_MATCHES}"
    ]


def _unused(edges: Sequence[CalibratedEdge]) -> list[str]:
    return [f"edge {edge.i}–{edge.j} is not used: {edge.reason}" for edge in edges if not edge.used]


def _unconfirmed(edges: Sequence[CalibratedEdge], view: CameraView) -> list[str]:
    used = [edge for edge in edges if edge.used]
    if len(used) > 1:
        return []
    told = f"only one overlap holds camera {view.camera_id} ({view.name})"
    return [f"{told}: a false match there, or a neighbour that has moved, too, would not show"]


def _not_about(camera_id: int, sentences: Sequence[str]) -> list[str]:
    """The gate's sentences but for those on this camera or an edge of it."""
    own = re.compile(
        rf"(only one overlap holds )?camera {camera_id} \(|edge ({camera_id}–\d+|\d+–{camera_id}) "
    )
    return [sentence for sentence in sentences if not own.match(sentence)]


def _evidence(local: CalibrationResult, view: CameraView) -> tuple[EdgeEvidence, ...]:
    return tuple(one for one in local.evidence if view.camera_id in (one.i, one.j))


def _camera(held: HeldAdjustment, known: RigCalibration, view: CameraView) -> CalibratedCamera:
    before = known.camera(view.camera_id)
    return CalibratedCamera(
        id=view.camera_id,
        name=view.name,
        T_rig_camera=held.T_rig_camera,
        depth_correction=held.correction,
        serial=None if before is None else before.serial,
    )


def _merged(
    known: RigCalibration, camera: CalibratedCamera, held: HeldAdjustment, edges: Sequence[CalibratedEdge]
) -> RigCalibration:
    """`known` with this camera, its covariance and its edges in place of the old ones."""
    ids = [one.id for one in known.cameras if one.id != camera.id]
    joint = _joint_covariance(known, ids)
    if joint is not None:
        joint = _extended(joint, [ids.index(c) for c in held.held], held)
        poses = [*(known.poses[camera_id] for camera_id in ids), camera.T_rig_camera]
        aligned = PoseCovariance(joint.reshape(len(poses), 6, len(poses), 6)).aligned(poses)
        camera = replace(
            camera,
            covariance=np.ascontiguousarray(joint[-6:, -6:]),
            aligned_covariance=aligned.of(len(ids)),
        )
    cameras = (*(one for one in known.cameras if one.id != camera.id), camera)
    order = sorted(range(len(cameras)), key=lambda k: cameras[k].id)
    merged = replace(
        known,
        cameras=tuple(cameras[k] for k in order),
        joint_covariance=None if joint is None else _blocks(joint, order, order),
    )
    kept = [edge for edge in known.edges if camera.id not in (edge.i, edge.j)]
    own = [replace(edge, relative_covariance=merged.relative_covariance(edge.i, edge.j)) for edge in edges]
    all_edges = tuple(sorted([*kept, *own], key=lambda edge: (edge.i, edge.j)))
    return replace(merged, edges=all_edges, loop_closure=_loop_closure(all_edges, merged.poses))


def _joint_covariance(known: RigCalibration, camera_ids: Sequence[int]) -> Array | None:
    """Of these cameras' poses (6N,6N); None when the calibration gives no covariance."""
    if known.joint_covariance is not None:
        rows = [[camera.id for camera in known.cameras].index(camera_id) for camera_id in camera_ids]
        return _blocks(known.joint_covariance, rows, rows)
    own = [camera.covariance for camera in known.cameras if camera.id in camera_ids]
    stated = [covariance for covariance in own if covariance is not None]
    return np.asarray(scipy.linalg.block_diag(*stated)) if len(stated) == len(own) else None


def _extended(joint: Array, held: Sequence[int], adjusted: HeldAdjustment) -> Array:
    """The joint covariance with one more camera, last, whose pose sways with those of the `held` rows."""
    cross = adjusted.sway @ _blocks(joint, held, range(len(joint) // 6))
    own = adjusted.covariance + cross[:, _columns(held)] @ adjusted.sway.T
    return np.block([[joint, cross.T], [cross, 0.5 * (own + own.T)]])


def _columns(cameras: Sequence[int]) -> npt.NDArray[np.intp]:
    return (6 * np.array(cameras, dtype=np.intp)[:, None] + np.arange(6)).ravel()


def _blocks(matrix: Array, rows: Sequence[int], columns: Sequence[int]) -> Array:
    return np.ascontiguousarray(matrix[np.ix_(_columns(rows), _columns(columns))])


def _loop_closure(edges: Sequence[CalibratedEdge], poses: Mapping[int, Pose]) -> LoopClosure | None:
    measured = {
        (edge.i, edge.j): edge.T_i_j for edge in edges if edge.used and {edge.i, edge.j} <= poses.keys()
    }
    cycle = closing_cycle(list(measured))
    if cycle is None:
        return None
    after = {(i, j): inverse(poses[i]) @ poses[j] for i, j in measured}
    return LoopClosure(*loop_error(cycle, measured), *loop_error(cycle, after))
