"""A pose graph some of whose edges are wrong: graduated non-convexity with truncated least squares.

Minimises Σ min(rᵀ Λ r, c²) by weighted least squares whose weights harden (Yang, Antonante, Tzoumas &
Carlone, "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020), from up to two starts.
"""

import numpy as np
import numpy.typing as npt

from rig_calib.pose_graph.block_matrix import BlockPattern
from rig_calib.pose_graph.edge_batch import EdgeBatch, Objective
from rig_calib.pose_graph.optimiser import minimise
from rig_calib.pose_graph.short_cycles import on_agreeing_cycle
from rig_calib.pose_graph.start import chordal_start
from rig_calib.stages import Progress

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

# 99.9999 % of a six-dimensional residual: an edge beyond is wrong, not unlucky.
WRONG = 38.3
_HARDENING = 1.4
_MAX_ROUNDS, _STEPS_A_ROUND = 150, 2
_RECLASSIFICATIONS = 10
_ENOUGH_IF_NONE_IS_WRONG = 15  # iterations of plain least squares; with wrong edges it would take many
_DOUBTFUL_WEIGHT = 1e-6


def reject_wrong_edges(
    T: Array,
    edges: EdgeBatch,
    pattern: BlockPattern,
    objective: Objective,
    tell: Progress,
) -> tuple[Array, Mask]:
    """Poses (N,4,4) that explain as many edges as possible, and which edges (M,) they explain.

    Of T only the fixed poses count. One start believes the edges of short cycles that close; where all
    consecutive nodes are joined, another trusts this odometry while the weights harden. The better result
    is taken, and its verdict trusts nothing. What is kept ties every pose to a fixed one.
    """
    start = chordal_start(T, edges, pattern)
    plain, _, _ = minimise(start, edges, pattern, objective, _ENOUGH_IF_NONE_IS_WRONG)
    distance = edges.squared_distances(plain, objective)
    if (distance <= WRONG).all():
        return plain, np.ones(len(edges), dtype=bool)
    found: list[tuple[Array, Mask]] = []
    for believed, trusted in _starts(edges, len(T)):
        tell("wrong edges", 0.4 * len(found))
        start = chordal_start(T, edges.weighted(np.where(believed, 1.0, _DOUBTFUL_WEIGHT)), pattern)
        hardened = _harden(start, edges, pattern, objective, trusted)
        found.append(_reclassified(hardened, edges, pattern, objective))
    return min(found, key=lambda one: _truncated(edges.squared_distances(one[0], objective)))


def _starts(edges: EdgeBatch, count: int) -> list[tuple[Mask, Mask]]:
    """Which edges (M,) a start follows, and which of them keep their weight until the verdict."""
    starts = [(on_agreeing_cycle(edges), np.zeros(len(edges), dtype=bool))]
    odometry = np.abs(edges.j - edges.i) == 1
    if len(np.unique(np.minimum(edges.i, edges.j)[odometry])) == count - 1:
        starts.append((odometry, odometry))
    return starts


def _harden(T: Array, edges: EdgeBatch, pattern: BlockPattern, objective: Objective, trusted: Mask) -> Array:
    """Weighted least squares, its weights from all near one to zero or one; trusted edges keep theirs."""
    distance = edges.squared_distances(T, objective)
    mu = WRONG / max(2.0 * float(distance.max(initial=0.0)) - WRONG, WRONG)
    for _ in range(_MAX_ROUNDS):
        weights = np.where(trusted, 1.0, _weights(distance, mu))
        T, _, _ = minimise(T, edges.weighted(weights), pattern, objective, _STEPS_A_ROUND)
        distance = edges.squared_distances(T, objective)
        mu *= _HARDENING
        if ((weights == 0.0) | (weights == 1.0)).all():
            break
    return T


def _weights(distance: Array, mu: float) -> Array:
    """Eq. 14 of the paper: the minimiser of the truncated quadratic's surrogate."""
    between = np.sqrt(WRONG * mu * (mu + 1.0) / np.maximum(distance, 1e-12)) - mu
    return np.where(
        distance <= WRONG * mu / (mu + 1.0), 1.0, np.where(distance >= WRONG * (mu + 1.0) / mu, 0.0, between)
    )


def _reclassified(
    T: Array, edges: EdgeBatch, pattern: BlockPattern, objective: Objective
) -> tuple[Array, Mask]:
    """Least squares over what agrees, until the same edges agree with the result; poses and these edges."""
    kept = _tied(edges, edges.squared_distances(T, objective), pattern.order, len(T))
    for _ in range(_RECLASSIFICATIONS):
        T, _, _ = minimise(T, edges.weighted(kept.astype(np.float64)), pattern, objective)
        before, kept = kept, _tied(edges, edges.squared_distances(T, objective), pattern.order, len(T))
        if (kept == before).all():
            break
    return T, kept


def _tied(edges: EdgeBatch, distance: Array, free: Index, count: int) -> Mask:
    """The edges (M,) that agree, and of the others the nearest that tie every pose to a fixed one.

    Nothing contradicts those: a part of the graph that hangs on one edge can always follow it.
    """
    kept = distance <= WRONG
    while True:
        parts = edges.select(kept).parts(count)
        parts[np.isin(parts, np.delete(parts, free))] = -1
        across = np.flatnonzero(parts[edges.i] != parts[edges.j])
        if not len(across):
            return kept
        kept[across[np.argmin(distance[across])]] = True


def _truncated(distance: Array) -> float:
    return float(np.minimum(distance, WRONG).sum())
