"""Edges of a pose graph and how they connect: trees, groups, loops.

Edges are T_i_j with an information matrix for errors on their right: T_true = T_i_j · Exp(δ), rotation first.
"""

from collections import defaultdict, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse
import scipy.sparse.csgraph
import scipy.sparse.linalg

from rig_protocol.poses import Pose, inverse, rotation_angle_deg, se3_log

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


def edge_residual(edge: PoseEdge, poses: Mapping[int, Pose]) -> Array:
    """r_ij (6,): the edge's error vector under given poses."""
    return se3_log(inverse(edge.T_i_j) @ inverse(poses[edge.i]) @ poses[edge.j])


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
