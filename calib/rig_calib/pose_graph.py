"""Pose graph over SE(3): the poses that agree best with measured relative poses (eq. 6 of the paper).

Edges are T_i_j with an information matrix for errors on their right: T_true = T_i_j · Exp(δ), rotation first.
Any graph will do: a ring with its loop closure, all pairs of a rig, a map of thousands of poses.
"""

from collections import defaultdict, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse
import scipy.sparse.csgraph
import scipy.sparse.linalg

from rig_protocol.poses import Pose, adjoint, hat, inverse, rotation_angle_deg, se3_exp, se3_log

Array = npt.NDArray[np.float64]

_MAX_ITERATIONS = 100
_CONVERGED = 1e-10  # relative decrease of the cost


@dataclass(frozen=True, slots=True, eq=False)
class PoseEdge:
    """A measured relative pose T_i_j with its information (6,6)."""

    i: int
    j: int
    T_i_j: Pose
    information: Array


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraphResult:
    """Optimised poses by id, the cost ½ Σ rᵀ Λ r, and the covariance's source: the normal matrix.

    `order` are the ids of the free poses, whose 6-blocks `normal` holds.
    """

    poses: Mapping[int, Pose]
    cost: float
    order: tuple[int, ...]
    normal: scipy.sparse.csc_array
    iterations: int


def edge_residual(edge: PoseEdge, poses: Mapping[int, Pose]) -> Array:
    """r_ij (6,): the edge's error vector under given poses."""
    return se3_log(inverse(edge.T_i_j) @ inverse(poses[edge.i]) @ poses[edge.j])


def optimise(start: Mapping[int, Pose], edges: Sequence[PoseEdge], fixed: Iterable[int]) -> PoseGraphResult:
    """Minimise eq. 6 by Levenberg-Marquardt from `start`; the `fixed` poses define the frame."""
    fixed = set(fixed)
    order = tuple(sorted(node for node in start if node not in fixed))
    column = {node: 6 * k for k, node in enumerate(order)}
    poses = dict(start)
    normal, gradient, cost = _linearise(poses, edges, column)
    damping, iteration = 1e-6, 0
    while iteration < _MAX_ITERATIONS and damping < 1e10 and order:
        iteration += 1
        moved = _moved(poses, order, _solve(normal, gradient, damping))
        candidate = _linearise(moved, edges, column)
        if candidate[2] > cost:
            damping *= 10.0
            continue
        decrease = cost - candidate[2]
        poses, (normal, gradient, cost) = moved, candidate
        damping = max(damping * 0.1, 1e-12)
        if decrease <= _CONVERGED * (cost + decrease):
            break
    return PoseGraphResult(poses, cost, order, normal, iteration)


def spanning_tree(edges: Sequence[PoseEdge], cost: Sequence[float]) -> list[PoseEdge]:
    """The edges of the minimum spanning tree, or forest, for positive costs."""
    nodes = sorted({node for edge in edges for node in (edge.i, edge.j)})
    index = {node: k for k, node in enumerate(nodes)}
    cheapest: dict[tuple[int, int], int] = {}
    for k in sorted(range(len(edges)), key=lambda k: -cost[k]):
        cheapest[index[edges[k].i], index[edges[k].j]] = k
    rows, columns = zip(*cheapest, strict=True) if cheapest else ((), ())
    weights = [cost[k] for k in cheapest.values()]
    graph = scipy.sparse.coo_array((weights, (rows, columns)), shape=(len(nodes), len(nodes)))
    tree = scipy.sparse.csgraph.minimum_spanning_tree(graph.tocsr()).tocoo()
    return [edges[cheapest[int(r), int(c)]] for r, c in zip(*tree.coords, strict=True)]


def chain_poses(edges: Sequence[PoseEdge], root: int, T_root: Pose) -> dict[int, Pose]:
    """Poses of everything that edges connect to the root, composed breadth first."""
    neighbours: dict[int, list[tuple[int, Pose]]] = defaultdict(list)
    for edge in edges:
        neighbours[edge.i].append((edge.j, edge.T_i_j))
        neighbours[edge.j].append((edge.i, inverse(edge.T_i_j)))
    poses, queue = {root: T_root}, deque([root])
    while queue:
        node = queue.popleft()
        for other, T in neighbours[node]:
            if other not in poses:
                poses[other] = poses[node] @ T
                queue.append(other)
    return poses


def connected_groups(nodes: Iterable[int], pairs: Iterable[tuple[int, int]]) -> list[list[int]]:
    """Groups of connected nodes, the largest first, each ascending."""
    ids = sorted(nodes)
    index = {node: k for k, node in enumerate(ids)}
    links = [(index[i], index[j]) for i, j in pairs]
    rows, columns = zip(*links, strict=True) if links else ((), ())
    graph = scipy.sparse.coo_array((np.ones(len(links)), (rows, columns)), shape=(len(ids), len(ids)))
    count, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    groups = [[ids[k] for k in np.flatnonzero(label == group)] for group in range(count)]
    return sorted(groups, key=lambda group: (-len(group), group[0]))


def loop_error(cycle: Sequence[int], relative: Mapping[tuple[int, int], Pose]) -> tuple[float, float]:
    """By how much a cycle of relative poses fails to close: degrees and millimetres.

    `cycle` lists the nodes once; `relative` holds T_i_j for each step in either direction.
    """
    T = np.eye(4)
    for i, j in zip(cycle, [*cycle[1:], cycle[0]], strict=True):
        T = T @ (relative[i, j] if (i, j) in relative else inverse(relative[j, i]))
    return rotation_angle_deg(T), float(np.linalg.norm(T[:3, 3]) * 1e3)


def _linearise(
    poses: Mapping[int, Pose], edges: Sequence[PoseEdge], column: Mapping[int, int]
) -> tuple[scipy.sparse.csc_array, Array, float]:
    """Normal matrix and gradient of the free poses, and the cost."""
    rows, columns, values = [], [], []
    gradient, cost = np.zeros(6 * len(column)), 0.0
    block = np.arange(6)
    for edge in edges:
        r = edge_residual(edge, poses)
        cost += 0.5 * float(r @ edge.information @ r)
        by_j = _inverse_right_jacobian(r)
        by_i = -by_j @ adjoint(inverse(poses[edge.j]) @ poses[edge.i])
        free = [(column[node], J) for node, J in ((edge.i, by_i), (edge.j, by_j)) if node in column]
        for a, J_a in free:
            weighted = J_a.T @ edge.information
            gradient[a : a + 6] += weighted @ r
            for b, J_b in free:
                rows.append(np.repeat(a + block, 6))
                columns.append(np.tile(b + block, 6))
                values.append((weighted @ J_b).ravel())
    size = len(gradient)
    if not values:
        return scipy.sparse.csc_array((size, size)), gradient, cost
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return scipy.sparse.coo_array(entries, shape=(size, size)).tocsc(), gradient, cost


def _inverse_right_jacobian(delta: Array) -> Array:
    """First terms of the series of the inverse right Jacobian of SE(3): I + ½ ad + ad²/12."""
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = hat(delta[:3])
    ad[3:, :3] = hat(delta[3:])
    return np.asarray(np.eye(6) + 0.5 * ad + ad @ ad / 12.0)


def _solve(normal: scipy.sparse.csc_array, gradient: Array, damping: float) -> Array:
    diagonal = scipy.sparse.diags_array(damping * normal.diagonal() + 1e-12)
    return np.asarray(scipy.sparse.linalg.spsolve((normal + diagonal).tocsc(), -gradient))


def _moved(poses: Mapping[int, Pose], order: Sequence[int], step: Array) -> dict[int, Pose]:
    moved = dict(poses)
    for k, node in enumerate(order):
        moved[node] = poses[node] @ se3_exp(step[6 * k : 6 * k + 6])
    return moved
