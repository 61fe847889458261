"""Which edges tell one story: start poses for all cameras, and the edges that contradict the others.

A pair of cameras may agree on a false pose (repeated texture, chance). Random spanning trees propose poses
for the rig; the proposal that most edges agree with starts a pose graph, from which the worst edge is
dropped until none contradicts.
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.edges import Edge
from rig_calib.pose_graph import (
    PoseEdge,
    chain_poses,
    connected_groups,
    edge_residual,
    optimise,
    spanning_tree,
    squared_distances,
)
from rig_protocol.poses import Pose, inverse, se3_log

Array = npt.NDArray[np.float64]

_TREES, _SETTLED_TREES = 60, 5
_WORTH_A_MOVE = 0.1  # of an edge: every move gains that much, so moving ends
# What an edge's own covariance does not hold (moving cameras, shutter, wrong intrinsics), per axis.
_FLOOR_DEG, _FLOOR_M = 0.5, 0.015
# 99.9999 % of a six-dimensional residual: a dropped edge is false, not unlucky.
_CONTRADICTION = 38.3
_AGREEMENT = 12.6  # 95 %; a proposal counts edges by how far they stay below this
_DRAWING_WEIGHT = 0.5  # of a drawn relative pose against a measured one


@dataclass(frozen=True, slots=True, eq=False)
class ConsistentGraph:
    """Poses of the largest connected group (its first camera at the origin) and all edges, judged.

    `edges` are the given ones; those that contradict carry a reason. `ambiguous` are the pairs dropped from
    a loop in which any other edge might be the false one.
    """

    poses: Mapping[int, Pose]
    edges: tuple[Edge, ...]
    ambiguous: tuple[tuple[int, int], ...]


def consistent_graph(
    edges: Sequence[Edge], camera_ids: Sequence[int], nominal: Mapping[int, Pose], seed: int
) -> ConsistentGraph:
    """Judge edges against each other and, weakly, against the drawing; `nominal` holds known T_rig_camera."""
    usable = {edge.pair: pose_edge(edge) for edge in edges if edge.reason is None}
    if not camera_ids:
        return ConsistentGraph({}, tuple(edges), ())
    group = connected_groups(camera_ids, usable)[0]
    inside = {pair: edge for pair, edge in usable.items() if pair[0] in group}
    if not inside:
        return ConsistentGraph({group[0]: np.eye(4)}, tuple(edges), ())
    drawn = _drawn(inside, nominal)
    start = _best_proposal(inside, group, list(drawn.values()), seed)
    confirmed = {pair for pair, drawing in drawn.items() if _agree(inside[pair], drawing)}
    poses, dropped = _drop_contradictions(inside, start, group[0], confirmed)
    kept = [pair for pair in inside if pair not in dropped]
    ambiguous = [] if nominal else [pair for pair in dropped if _only_one_loop(pair, kept)]
    judged = tuple(edge.refused(dropped[edge.pair]) if edge.pair in dropped else edge for edge in edges)
    return ConsistentGraph(poses, judged, tuple(ambiguous))


def unconfirmed(pairs: Sequence[tuple[int, int]], camera_ids: Sequence[int]) -> list[tuple[int, int]]:
    """Edges that lie on no loop: nothing confirms them."""
    count = len(connected_groups(camera_ids, pairs))
    return [
        pair
        for pair in pairs
        if len(connected_groups(camera_ids, [other for other in pairs if other != pair])) > count
    ]


def pose_edge(edge: Edge) -> PoseEdge:
    """A measured edge for the pose graph, its covariance raised to what pairs are good for at best."""
    if edge.T_i_j is None or edge.covariance is None:
        raise ValueError(f"edge {edge.pair} has no pose")
    floor = np.diag(np.repeat([np.deg2rad(_FLOOR_DEG), _FLOOR_M], 3) ** 2)
    information = np.asarray(np.linalg.inv(edge.covariance + floor), dtype=np.float64)
    return PoseEdge(edge.i, edge.j, edge.T_i_j, information)


def _drawn(
    measured: Mapping[tuple[int, int], PoseEdge], nominal: Mapping[int, Pose]
) -> dict[tuple[int, int], PoseEdge]:
    """The drawing's relative poses of the measured pairs, loosely: a mount may be off by several degrees."""
    information = np.diag(1.0 / np.repeat([np.deg2rad(2.0), 0.01], 3) ** 2)
    return {
        (i, j): PoseEdge(i, j, inverse(nominal[i]) @ nominal[j], information)
        for i, j in measured
        if i in nominal and j in nominal
    }


def _agree(measured: PoseEdge, drawn: PoseEdge) -> bool:
    """Whether a measured relative pose is the drawn one within the uncertainty of both."""
    r = se3_log(inverse(measured.T_i_j) @ drawn.T_i_j)
    covariance = np.linalg.inv(measured.information) + np.linalg.inv(drawn.information)
    return float(r @ np.linalg.solve(covariance, r)) <= _AGREEMENT


def _best_proposal(
    edges: Mapping[tuple[int, int], PoseEdge], group: Sequence[int], drawn: Sequence[PoseEdge], seed: int
) -> dict[int, Pose]:
    """Poses that the most edges agree with: the best spanning trees, their misplaced cameras moved."""
    rng = np.random.default_rng(seed)
    listed = list(edges.values())
    cost = np.array([np.trace(np.linalg.inv(edge.information)) for edge in listed])
    simplest = chain_poses(spanning_tree(listed, cost.tolist()), group[0], np.eye(4))
    if (squared_distances(listed, simplest) <= _AGREEMENT).all():
        return simplest  # nothing contradicts anything
    costs = [cost, *(rng.exponential(cost) for _ in range(_TREES - 1))]
    trees = [chain_poses(spanning_tree(listed, one.tolist()), group[0], np.eye(4)) for one in costs]

    def score(poses: Mapping[int, Pose]) -> float:
        return _score(listed, drawn, poses)

    settled = [_settled(poses, listed, drawn) for poses in sorted(trees, key=score)[:_SETTLED_TREES]]
    best = min(settled, key=score)
    return {camera_id: inverse(best[group[0]]) @ pose for camera_id, pose in best.items()}


def _settled(poses: dict[int, Pose], edges: Sequence[PoseEdge], drawn: Sequence[PoseEdge]) -> dict[int, Pose]:
    """Move one camera at a time to where one of its edges wants it, as long as more edges agree then.

    A tree hangs a camera on one edge; if that is a false one, the camera's other edges outvote it here.
    """
    moved = True
    while moved:
        moved = False
        for camera_id in poses:
            own = [edge for edge in edges if camera_id in (edge.i, edge.j)]
            own_drawn = [edge for edge in drawn if camera_id in (edge.i, edge.j)]
            places = [poses | {camera_id: _place(camera_id, edge, poses)} for edge in own]
            best = min(places, key=lambda placed: _score(own, own_drawn, placed))  # used at once
            if _score(own, own_drawn, best) < _score(own, own_drawn, poses) - _WORTH_A_MOVE:
                poses, moved = best, True
    return poses


def _place(camera_id: int, edge: PoseEdge, poses: Mapping[int, Pose]) -> Pose:
    """Where an edge says that one of its cameras is, given the other."""
    if camera_id == edge.j:
        return np.asarray(poses[edge.i] @ edge.T_i_j)
    return np.asarray(poses[edge.j] @ inverse(edge.T_i_j))


def _score(edges: Sequence[PoseEdge], drawn: Sequence[PoseEdge], poses: Mapping[int, Pose]) -> float:
    """How many measured edges disagree, and how much of the drawing."""
    return _disagreement(edges, poses) + _DRAWING_WEIGHT * _disagreement(drawn, poses)


def _disagreement(edges: Sequence[PoseEdge], poses: Mapping[int, Pose]) -> float:
    """How many edges disagree, each counted up to one."""
    return float(np.minimum(squared_distances(edges, poses) / _AGREEMENT, 1.0).sum()) if edges else 0.0


def _distances(
    edges: Mapping[tuple[int, int], PoseEdge], poses: Mapping[int, Pose]
) -> dict[tuple[int, int], float]:
    return dict(zip(edges, squared_distances(list(edges.values()), poses).tolist(), strict=True))


def _drop_contradictions(
    edges: Mapping[tuple[int, int], PoseEdge],
    poses: Mapping[int, Pose],
    root: int,
    confirmed: Set[tuple[int, int]],
) -> tuple[Mapping[int, Pose], dict[tuple[int, int], str]]:
    """Optimise over the edges that agree with the start, then drop, worst first, what contradicts.

    What the drawing confirmed is imprecise, not false, and stays: a long loop adds up many small errors.
    """
    start = _distances(edges, poses)
    kept = {p: edge for p, edge in edges.items() if p in confirmed or start[p] <= _CONTRADICTION}
    while True:
        poses = optimise(poses, list(kept.values()), [root]).poses
        distances = {
            pair: distance for pair, distance in _distances(kept, poses).items() if pair not in confirmed
        }
        worst = max(distances, key=lambda pair: distances[pair], default=None)
        if worst is None or distances[worst] <= _CONTRADICTION:
            break
        del kept[worst]
    # An edge that only the rough start refused may agree with the optimised poses.
    found = _distances(edges, poses)
    kept |= {pair: edge for pair, edge in edges.items() if found[pair] <= _AGREEMENT}
    poses = optimise(poses, list(kept.values()), [root]).poses
    return poses, {pair: _contradiction(edge, poses) for pair, edge in edges.items() if pair not in kept}


def _contradiction(edge: PoseEdge, poses: Mapping[int, Pose]) -> str:
    r = edge_residual(edge, poses)
    rotation_deg, distance_mm = np.rad2deg(np.linalg.norm(r[:3])), np.linalg.norm(r[3:]) * 1e3
    return f"contradicts the other edges by {rotation_deg:.1f}° and {distance_mm:.0f} mm"


def _only_one_loop(pair: tuple[int, int], kept: Sequence[tuple[int, int]]) -> bool:
    """True when the pair closed a loop none of whose other edges lies on a second loop."""
    nodes = sorted({node for edge in [*kept, pair] for node in edge})
    alone = set(unconfirmed(kept, nodes))
    return any(edge in alone for edge in kept) and all(
        edge in alone for edge in kept if edge not in unconfirmed([*kept, pair], nodes)
    )
