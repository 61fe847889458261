"""The calibration of a rig, stage after stage, as the paper tells it.

Keypoints on the overlaps, matches, 3D points, relative poses of pairs (sections II-A), and a pose graph
closed over the loop (II-B). The method `joint` puts one adjustment of everything in place of the last.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rig_calib import gate
from rig_calib.alignment import align_frames
from rig_calib.consistency import ConsistentGraph, consistent_graph, pose_edge
from rig_calib.edges import Edge, measure_edge
from rig_calib.evidence import EdgeEvidence, corrected, edge_evidence
from rig_calib.joint_estimate import estimate_jointly
from rig_calib.loops import closing_cycle
from rig_calib.matching import Matches, flann_matches, mutual_matches
from rig_calib.observed_camera import ObservedCamera, missing_images, observe
from rig_calib.overlap import Region, joined, shared_regions
from rig_calib.parallel import in_threads
from rig_calib.pose_graph import chain_poses, loop_error, optimise, spanning_tree
from rig_calib.rig_adjustment import AdjustedRig
from rig_calib.rig_calibration import CalibratedCamera, CalibratedEdge, LoopClosure, RigCalibration
from rig_calib.settings import CalibrationSettings
from rig_calib.stages import Progress, Stages
from rig_calib.view import CameraView
from rig_protocol.poses import Pose, inverse
from rig_protocol.rig_folder import RingDrawing

Pair = tuple[int, int]

# A mount may be off by several degrees and be found all the same.
_OVERLAP_MARGIN_DEG = 7.0


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """The calibration, and what a report draws of it.

    `poses_before` are T_rig_camera before the loop is closed; `rig` is None for the method `paper`.
    """

    calibration: RigCalibration
    evidence: tuple[EdgeEvidence, ...]
    poses_before: Mapping[int, Pose]
    rig: AdjustedRig | None


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    cameras: Mapping[int, ObservedCamera]
    edges: Sequence[Edge]
    poses: Mapping[int, Pose]
    rig: AdjustedRig | None


def calibrate(
    views: Sequence[CameraView],
    ring: RingDrawing | None,
    settings: CalibrationSettings,
    progress: Progress | None = None,
) -> CalibrationResult:
    """Calibrate a rig from its views; never raises for a poor capture, whose `failures` say what is wrong.

    `ring` gives the tolerance of the views' nominal poses (default: that of `RingDrawing`); without such
    poses every pair of cameras is a candidate. DataError when images do not fit their camera's model.
    """
    stages = Stages(progress)
    ring = ring or RingDrawing()
    nominal = {view.camera_id: view.T_rig_nominal for view in views if view.T_rig_nominal is not None}
    usable = [view for view in views if missing_images(view) is None]

    # Features: keypoints with depth on the overlaps
    with stages.stage("features"):
        regions = _regions(usable)
        cameras = _observe_all(usable, regions, settings, stages)

    # Matching: keypoints that look alike
    with stages.stage("matching"):
        found = in_threads(lambda pair: _match(cameras, pair, regions[pair], settings), regions)
        matches = dict(zip(regions, found, strict=True))

    # Registration: each pair alone (eq. 4, 5), then all pairs against each other
    with stages.stage("registration"):
        edges = []
        for edge in in_threads(lambda pair: _measure(cameras, pair, matches[pair], settings), matches):
            edges.append(edge)
            stages.tell(len(edges) / len(matches))
        graph = consistent_graph(edges, list(cameras), nominal, settings.seed)

    # Optimisation: pose graph (eq. 6) or joint adjustment
    with stages.stage("optimisation"):
        start = _in_rig_frame(graph.poses, nominal)
        before = _in_rig_frame(_open_chain(graph), nominal)
        if settings.method == "paper":
            solution = _solve_pose_graph(cameras, graph, start)
        else:
            solution = _solve_jointly(cameras, regions, graph, start, ring if nominal else None, settings)

    failures, warnings = _judge(views, graph, solution, ring if nominal else None, settings)
    calibration = RigCalibration(
        method=settings.method,
        rig_frame="ring" if nominal.keys() & solution.poses.keys() else _first_camera(solution.poses),
        cameras=_calibrated_cameras(views, solution),
        edges=tuple(_calibrated_edge(edge, solution.rig) for edge in solution.edges),
        loop_closure=_loop_closure(solution),
        seconds=stages.seconds(),
        frames_used=max((len(view.color) for view in views), default=0),
        provenance={"settings": settings.model_dump(mode="json"), **_gravity(solution)},
        warnings=tuple(warnings),
        failures=tuple(failures),
        joint_covariance=None
        if solution.rig is None
        else solution.rig.joint_covariance(_placed(views, solution)),
    )
    evidence = tuple(edge_evidence(solution.cameras, solution.edges, solution.poses, solution.rig))
    return CalibrationResult(calibration, evidence, before, solution.rig)


def _regions(views: Sequence[CameraView]) -> dict[Pair, tuple[Region, Region]]:
    """Where the drawing, with a margin, says that two cameras may see the same things."""
    models = {view.camera_id: view.model.color for view in views}
    return shared_regions(models, {view.camera_id: view.T_rig_nominal for view in views}, _OVERLAP_MARGIN_DEG)


def _observe_all(
    views: Sequence[CameraView],
    regions: Mapping[Pair, tuple[Region, Region]],
    settings: CalibrationSettings,
    stages: Stages,
) -> dict[int, ObservedCamera]:
    """Cameras that may share a view, observed where they may."""
    wanted: dict[int, list[Region]] = {}
    for pair, sides in regions.items():
        for camera_id, region in zip(pair, sides, strict=True):
            wanted.setdefault(camera_id, []).append(region)
    sharing = [view for view in views if view.camera_id in wanted]
    cameras = {}
    observed = in_threads(lambda view: observe(view, joined(wanted[view.camera_id]), settings), sharing)
    for view, camera in zip(sharing, observed, strict=True):
        cameras[view.camera_id] = camera
        stages.tell(len(cameras) / len(sharing))
    return cameras


def _match(
    cameras: Mapping[int, ObservedCamera],
    pair: Pair,
    regions: tuple[Region, Region],
    settings: CalibrationSettings,
) -> Matches:
    a, b = cameras[pair[0]].keypoints, cameras[pair[1]].keypoints
    if settings.method == "paper":
        return flann_matches(a, b, regions, settings.match_distance_multiple, settings.seed)
    return mutual_matches(a, b, regions, settings.match_ratio, settings.match_max_distance)


def _measure(
    cameras: Mapping[int, ObservedCamera], pair: Pair, matches: Matches, settings: CalibrationSettings
) -> Edge:
    return measure_edge(cameras[pair[0]], cameras[pair[1]], matches, settings)


def _solve_pose_graph(
    cameras: Mapping[int, ObservedCamera], graph: ConsistentGraph, start: Mapping[int, Pose]
) -> _Solution:
    """The paper's estimate: the pairs' relative poses, closed over the loops."""
    used = [pose_edge(edge) for edge in graph.edges if edge.reason is None and edge.i in start]
    poses = optimise(start, used, [min(start)]).poses if start else {}
    return _Solution(cameras, graph.edges, poses, None)


def _solve_jointly(
    cameras: Mapping[int, ObservedCamera],
    regions: Mapping[Pair, tuple[Region, Region]],
    graph: ConsistentGraph,
    start: Mapping[int, Pose],
    ring: RingDrawing | None,
    settings: CalibrationSettings,
) -> _Solution:
    """Beyond the paper: everything in one adjustment."""
    estimate = estimate_jointly(cameras, regions, graph.edges, start, ring, settings)
    if estimate is None:
        return _Solution(cameras, graph.edges, {}, None)
    rig = estimate.rig
    better = {c: corrected(camera, rig.corrections.get(c)) for c, camera in estimate.cameras.items()}
    return _Solution(better, estimate.edges, rig.poses, rig)


def _in_rig_frame(poses: Mapping[int, Pose], nominal: Mapping[int, Pose]) -> dict[int, Pose]:
    """Poses moved to where the drawing has the cameras; without a drawing, the first camera at the origin."""
    if len(poses) < 2:
        return {}
    drawn = bool(nominal.keys() & poses.keys())
    T = align_frames(poses, nominal) if drawn else inverse(poses[min(poses)])
    return {camera_id: T @ pose for camera_id, pose in poses.items()}


def _open_chain(graph: ConsistentGraph) -> dict[int, Pose]:
    """Poses composed along the best edges, no loop closed."""
    used = [pose_edge(edge) for edge in graph.edges if edge.reason is None and edge.i in graph.poses]
    cost = [float(np.trace(np.linalg.inv(edge.information))) for edge in used]
    return chain_poses(spanning_tree(used, cost), min(graph.poses, default=0), np.eye(4))


def _loop_closure(solution: _Solution) -> LoopClosure | None:
    """The loop over the pairs' own poses, and over those of the solution, which closes but for rounding."""
    used = {
        edge.pair: edge.T_i_j
        for edge in solution.edges
        if edge.reason is None and edge.T_i_j is not None and edge.i in solution.poses
    }
    cycle = closing_cycle(list(used))
    if cycle is None:
        return None
    after = {(i, j): inverse(solution.poses[i]) @ solution.poses[j] for i, j in used}
    return LoopClosure(*loop_error(cycle, used), *loop_error(cycle, after))


def _judge(
    views: Sequence[CameraView],
    graph: ConsistentGraph,
    solution: _Solution,
    ring: RingDrawing | None,
    settings: CalibrationSettings,
) -> tuple[list[str], list[str]]:
    """Failures and warnings of the quality gate."""
    failures = gate.unplaced(views, solution.edges, solution.poses) + gate.unclosed(graph)
    weak, warnings = gate.unsupported(solution.edges, solution.rig, ring is not None, settings)
    warnings += gate.unchecked(solution.edges, solution.poses)
    if ring is not None:
        warnings += gate.far_from_drawing(views, solution.poses, ring)
    return failures + weak, warnings


def _calibrated_cameras(views: Sequence[CameraView], solution: _Solution) -> tuple[CalibratedCamera, ...]:
    rig = solution.rig
    aligned = {} if rig is None else rig.aligned_covariances()
    return tuple(
        CalibratedCamera(
            id=view.camera_id,
            name=view.name,
            T_rig_camera=solution.poses[view.camera_id],
            covariance=None if rig is None else rig.covariance_of(view.camera_id),
            depth_correction=None if rig is None else rig.corrections[view.camera_id],
            aligned_covariance=aligned.get(view.camera_id),
        )
        for view in views
        if view.camera_id in solution.poses
    )


def _gravity(solution: _Solution) -> dict[str, list[int]]:
    """For the provenance: which cameras' accelerometers the adjustment has heard."""
    cameras = () if solution.rig is None else solution.rig.scene.cameras
    felt = [c for c in cameras if solution.cameras[c].view.gravity is not None]
    return {"gravity_cameras": felt} if felt else {}


def _placed(views: Sequence[CameraView], solution: _Solution) -> list[int]:
    return [view.camera_id for view in views if view.camera_id in solution.poses]


def _calibrated_edge(edge: Edge, rig: AdjustedRig | None) -> CalibratedEdge:
    placed = rig is not None and {edge.i, edge.j} <= rig.poses.keys()
    return CalibratedEdge(
        i=edge.i,
        j=edge.j,
        matches=len(edge.matches),
        inliers=int(edge.inlier.sum()),
        rms_mm=edge.rms_mm,
        T_i_j=np.eye(4) if edge.T_i_j is None else edge.T_i_j,
        used=edge.reason is None,
        reason=edge.reason,
        relative_covariance=rig.relative(edge.i, edge.j)[1] if rig is not None and placed else None,
    )


def _first_camera(poses: Mapping[int, Pose]) -> str:
    return f"camera {min(poses, default=0)}"
