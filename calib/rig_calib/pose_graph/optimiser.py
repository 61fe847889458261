"""Levenberg-Marquardt on a pose graph."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse

from rig_calib.pose_graph.block_matrix import BlockPattern, Matrix
from rig_calib.pose_graph.edge_batch import EdgeBatch, Objective
from rig_calib.pose_graph.graph import PoseEdge
from rig_calib.pose_graph.se3_batches import exponentials
from rig_protocol.poses import Pose

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_MAX_ITERATIONS = 100
_HOPELESS_DAMPING = 1e10
_CONVERGED = 1e-9  # relative decrease of the cost


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


def optimise(start: Mapping[int, Pose], edges: Sequence[PoseEdge], fixed: Iterable[int]) -> PoseGraphResult:
    """Minimise eq. 6 from `start`; the `fixed` poses define the frame."""
    ids = sorted(start)
    free = np.ones(len(ids), dtype=bool)
    row = {node: k for k, node in enumerate(ids)}
    free[[row[node] for node in set(fixed) if node in row]] = False
    T = np.array([start[node] for node in ids], dtype=np.float64).reshape(-1, 4, 4)
    batch = EdgeBatch.of(edges, row)
    pattern = BlockPattern(batch.i, batch.j, free)
    T, cost, iterations = minimise(T, batch, pattern, "geodesic")
    linearised = batch.linearised(T, "geodesic")
    normal = scipy.sparse.csc_array(pattern.matrix(linearised.ii, linearised.jj, linearised.ij))
    order = tuple(ids[k] for k in pattern.order)
    return PoseGraphResult(dict(zip(ids, T, strict=True)), cost, order, normal, iterations)


def minimise(
    T: Array,
    edges: EdgeBatch,
    pattern: BlockPattern,
    objective: Objective,
    max_iterations: int = _MAX_ITERATIONS,
    tell: Callable[[float], None] | None = None,
) -> tuple[Array, float, int]:
    """Poses (N,4,4) of least ½ Σ rᵀ Λ r from T, that cost, and the iterations it took."""
    cost = _cost(T, edges, objective)
    damping, iteration, converged = 1e-6, 0, pattern.count == 0
    while iteration < max_iterations and not converged:
        part = edges.linearised(T, objective)
        normal, gradient = pattern.matrix(part.ii, part.jj, part.ij), pattern.vector(part.i, part.j).ravel()
        better = None
        while better is None and iteration < max_iterations and damping < _HOPELESS_DAMPING:
            iteration += 1
            better = _better(T, cost, edges, pattern, objective, (normal, gradient, damping))
            damping = damping * 10.0 if better is None else max(damping * 0.1, 1e-12)
        if better is None:
            break
        converged = cost - better[1] <= _CONVERGED * cost
        T, cost = better
        if tell is not None:
            tell(cost)
    return T, cost, iteration


def _better(
    T: Array,
    cost: float,
    edges: EdgeBatch,
    pattern: BlockPattern,
    objective: Objective,
    system: tuple[Matrix, Array, float],
) -> tuple[Array, float] | None:
    """Poses after one damped step and their cost; None when that is no lower."""
    normal, gradient, damping = system
    try:
        step = pattern.solve(pattern.shifted(normal, damping, np.full(6, 1e-12)), -gradient)
    except np.linalg.LinAlgError:
        return None
    moved = T.copy()
    moved[pattern.order] = T[pattern.order] @ exponentials(step.reshape(-1, 6))
    moved_cost = _cost(moved, edges, objective)
    return (moved, moved_cost) if moved_cost <= cost else None


def _cost(T: Array, edges: EdgeBatch, objective: Objective) -> float:
    return 0.5 * float(edges.squared_distances(T, objective).sum())
