"""The calibration of a rig, stage after stage, as the paper tells it.

Keypoints on the overlaps, matches, 3D points, relative poses of pairs (sections II-A), and a pose graph
closed over the loop (II-B). The method `joint` puts one adjustment of everything in place of the last.
"""

import os
from collections.abc import Iterable, Mapping, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from rig_calib import gate
from rig_calib.alignment import align_frames
from rig_calib.consistency import ConsistentGraph, consistent_graph, pose_edge
from rig_calib.edges import TOLERANCE, Edge, estimate_edge, measure_edge
from rig_calib.evidence import EdgeEvidence
from rig_calib.loops import closing_cycle
from rig_calib.matching import Matches, flann_matches, mutual_matches
from rig_calib.noise import NoiseModel
from rig_calib.observed_camera import ObservedCamera, missing_images, observe
from rig_calib.overlap import Region, shared_regions
from rig_calib.pose_graph import chain_poses, loop_error, optimise, spanning_tree
from rig_calib.refinement import RefinedRig, refine
from rig_calib.registration import ransac
from rig_calib.reselection import corrected, edge_evidence
from rig_calib.rig_adjustment import AT_REST, AdjustedRig, adjust_rig
from rig_calib.rig_calibration import CalibratedCamera, CalibratedEdge, LoopClosure, RigCalibration
from rig_calib.settings import CalibrationSettings
from rig_calib.stages import Progress, Stages
from rig_calib.uncertainty import weakest_direction
from rig_calib.view import CameraView
from rig_protocol.poses import Pose, inverse, rotation_angle_deg
from rig_protocol.rig_folder import RingDrawing

Pair = tuple[int, int]

# A mount may be off by several degrees and be found all the same.
_OVERLAP_MARGIN_DEG = 7.0
# Rough, to judge how far a prediction may be off.
_FOCAL_PX, _NEAR_WALL_M = 525.0, 1.5
# Patches are looked for again while poses move by more than a patch's alignment makes up for.
_MAX_ROUNDS, _SETTLED_PX = 9, 3.0
_DEPTH_ROUNDS = 4  # of pairs that nothing but the drawing predicts
# What is far off must not count as an outlier at once: noise goes down to what it is.
_GRADUATED_NOISE = tuple(
    NoiseModel(pixel_distortion=pixels, disparity_distortion=steps)
    for pixels, steps in ((1.0, 4.0), (1.0, 2.0), (1.0, 1.0), (1.0, 0.5), (1.0, 0.3), (0.3, 0.15))
)
_FAR_AND_WIDE_PX = 4.0  # predictions worse than this find false places, too
# Fewer patches that were found far from where the drawing has them may agree by chance.
_MIN_PATCHES = 20
_NO_MATCHES: Matches = np.empty((0, 2), dtype=np.intp)


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
        regions = shared_regions(
            {view.camera_id: view.model.color for view in usable},
            {view.camera_id: view.T_rig_nominal for view in usable},
            _OVERLAP_MARGIN_DEG,
        )
        cameras = _observe_all(usable, regions, settings, stages)

    # Matching: keypoints that look alike
    with stages.stage("matching"):
        matches = {pair: _match(cameras, pair, regions[pair], settings) for pair in regions}

    # Registration: each pair alone (eq. 4, 5), then all pairs against each other
    with stages.stage("registration"):
        edges = []
        for k, ((i, j), rows) in enumerate(matches.items()):
            edges.append(measure_edge(cameras[i], cameras[j], rows, settings))
            stages.tell(k / len(matches))
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
        provenance={"settings": settings.model_dump(mode="json")},
        warnings=tuple(warnings),
        failures=tuple(failures),
        joint_covariance=None
        if solution.rig is None
        else solution.rig.joint_covariance(_placed(views, solution)),
    )
    evidence = tuple(edge_evidence(solution.cameras, solution.edges, solution.poses, solution.rig))
    return CalibrationResult(calibration, evidence, before, solution.rig)


def _observe_all(
    views: Sequence[CameraView],
    regions: Mapping[Pair, tuple[Region, Region]],
    settings: CalibrationSettings,
    stages: Stages,
) -> dict[int, ObservedCamera]:
    """Cameras that may share a view, observed where they may."""
    wanted: dict[int, Region] = {}
    for pair, sides in regions.items():
        for camera_id, region in zip(pair, sides, strict=True):
            wanted[camera_id] = region.union(wanted.get(camera_id, region))
    sharing = [view for view in views if view.camera_id in wanted]
    cameras = {}
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # detectors run without the interpreter's lock
        observed = pool.map(lambda v: observe(v, wanted[v.camera_id], settings), sharing)
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
    """Adjust on keypoints, then on patches that this finds, again while they are found elsewhere.

    With a drawing, cameras that no keypoint connects start from there.
    """
    if ring is not None:
        start = _drawn(cameras) | dict(start)
    if len(start) < 2:
        return _Solution(cameras, graph.edges, {}, None)
    keypoint_matches = _used_matches(graph.edges)
    rig = adjust_rig(cameras, keypoint_matches, start, ring, settings)
    far = {pair for pair, px in _prediction_px(rig, regions).items() if px > _FAR_AND_WIDE_PX}
    noise = AT_REST
    for k in range(_MAX_ROUNDS):
        before, prediction_px = rig.poses, _prediction_px(rig, regions)
        depth_only = far if k < _DEPTH_ROUNDS else set()
        refined = refine(
            cameras, regions, before, rig.corrections, prediction_px, depth_only, keypoint_matches
        )
        matches = _verified(refined, far - depth_only, prediction_px, settings)
        graduated = bool(far) and k < len(_GRADUATED_NOISE)
        rig = adjust_rig(
            refined.cameras, matches, before, ring, settings, _GRADUATED_NOISE[k] if graduated else noise
        )
        if not graduated:
            noise = rig.observed_noise()
            if _largest_shift_px(before, rig.poses, regions) < _SETTLED_PX:
                break
    if noise.differs_from(rig.noise):
        rig = adjust_rig(refined.cameras, matches, rig.poses, ring, settings, noise)
    edges = [_refined_edge(edge, refined, matches, rig, settings) for edge in graph.edges]
    better = {c: corrected(camera, rig.corrections.get(c)) for c, camera in refined.cameras.items()}
    return _Solution(better, edges, rig.poses, rig)


def _drawn(cameras: Mapping[int, ObservedCamera]) -> dict[int, Pose]:
    """Where the drawing has the cameras that it knows."""
    nominal = {c: camera.view.T_rig_nominal for c, camera in cameras.items()}
    return {c: T for c, T in nominal.items() if T is not None}


def _verified(
    refined: RefinedRig, far: Set[Pair], prediction_px: Mapping[Pair, float], settings: CalibrationSettings
) -> dict[Pair, Matches]:
    """The pairs' patches; of those that were looked for far and wide only what agrees on one pose.

    A pair that only the drawing predicted and that has no texture in common gets nothing: two bare walls look
    alike from many places.
    """
    out = {}
    for (i, j), rows in refined.matches.items():
        a, b = refined.cameras[i], refined.cameras[j]
        textured = a.keypoints.has_place[rows[:, 0]] & b.keypoints.has_place[rows[:, 1]]
        agreed = rows[textured]
        if prediction_px[i, j] > _FAR_AND_WIDE_PX:
            sides = a.side(agreed[:, 0]), b.side(agreed[:, 1])
            rng = np.random.default_rng([settings.seed, i, j])
            found = ransac(*sides, TOLERANCE, rng, settings.min_inliers)
            agreed = agreed[found[1]] if found is not None else _NO_MATCHES
        bare = (i, j) in far and len(agreed) < _MIN_PATCHES
        out[i, j] = _NO_MATCHES if bare else np.concatenate([agreed, rows[~textured]])
    return out


def _largest_shift_px(before: Mapping[int, Pose], after: Mapping[int, Pose], pairs: Iterable[Pair]) -> float:
    """By how many pixels predictions changed, at most."""
    shifts = [0.0]
    for i, j in pairs:
        if i in after and j in after:
            T = inverse(inverse(before[i]) @ before[j]) @ inverse(after[i]) @ after[j]
            turn_rad = np.deg2rad(rotation_angle_deg(T))
            shifts.append(_FOCAL_PX * float(np.hypot(turn_rad, np.linalg.norm(T[:3, 3]) / _NEAR_WALL_M)))
    return max(shifts)


def _refined_edge(
    edge: Edge,
    refined: RefinedRig,
    matches: Mapping[Pair, Matches],
    rig: AdjustedRig,
    settings: CalibrationSettings,
) -> Edge:
    """What the pair's patches alone say; without any it keeps why its keypoints gave nothing."""
    i, j = edge.pair
    rows = matches.get(edge.pair, _NO_MATCHES)
    if not len(rows):
        reason = edge.reason or "nothing that both cameras recognise was left when depth was corrected"
        return replace(edge, matches=_NO_MATCHES, inlier=np.zeros(0, dtype=bool), reason=reason)
    T_i_j = inverse(rig.poses[i]) @ rig.poses[j]
    return estimate_edge(refined.cameras[i], refined.cameras[j], rows, T_i_j, settings)


def _prediction_px(rig: AdjustedRig, pairs: Iterable[Pair]) -> dict[Pair, float]:
    """Standard deviation, in pixels, of where the poses put one camera's points in another."""
    out = {}
    for i, j in pairs:
        if i in rig.poses and j in rig.poses:
            sigma_deg, sigma_m = weakest_direction(rig.relative(i, j)[1])
            out[i, j] = _FOCAL_PX * float(np.hypot(np.deg2rad(sigma_deg), sigma_m / _NEAR_WALL_M))
    return out


def _used_matches(edges: Sequence[Edge]) -> dict[Pair, Matches]:
    return {edge.pair: edge.agreeing_matches for edge in edges if edge.reason is None}


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
