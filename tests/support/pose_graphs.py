"""Pose graphs with known poses: a spiral on a torus whose neighbouring turns see each other."""

import numpy as np
import numpy.typing as npt

from rig_calib.pose_graph.edge_batch import EdgeBatch
from rig_calib.pose_graph.g2o import PoseGraph
from rig_calib.pose_graph.se3_batches import exponentials, inverses

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

SIGMA = np.repeat([0.01, 0.03], 3)  # rad, metres


def spiral(
    count: int, per_turn: int = 50, sigma: Array = SIGMA, seed: int = 0, start_by: str = "odometry"
) -> tuple[PoseGraph, Array]:
    """A graph of odometry and edges to the next turn, noisy, and its true poses (count,4,4).

    The graph's own poses are the composed odometry, which drifts away; with `start_by` "truth" the true ones.
    """
    rng = np.random.default_rng(seed)
    truth = _torus(count, per_turn)
    step, turn = np.arange(count - 1), np.arange(count - per_turn)
    i, j = np.concatenate([step, turn]), np.concatenate([step + 1, turn + per_turn])
    noise = exponentials(sigma * rng.standard_normal((len(i), 6)))
    information = np.tile(np.diag(sigma**-2.0), (len(i), 1, 1))
    edges = EdgeBatch(i, j, inverses(truth[i]) @ truth[j] @ noise, information)
    T = truth.copy()
    if start_by == "odometry":
        for k in step:
            T[k + 1] = T[k] @ edges.T_i_j[k]
    fixed = np.zeros(count, dtype=bool)
    return PoseGraph(tuple(range(count)), T, edges, fixed), truth


def with_wrong_edges(
    graph: PoseGraph, candidates: Array, share: float, seed: int = 0
) -> tuple[PoseGraph, Mask]:
    """The graph with a share of the candidate edges measuring anything at all; which they are."""
    rng = np.random.default_rng(seed)
    wrong = rng.choice(candidates, int(share * len(candidates)), replace=False)
    T_i_j = graph.edges.T_i_j.copy()
    anything = np.concatenate(
        [rng.uniform(-2, 2, (len(wrong), 3)), rng.normal(0, 5, (len(wrong), 3))], axis=1
    )
    T_i_j[wrong] = exponentials(anything)
    edges = EdgeBatch(graph.edges.i, graph.edges.j, T_i_j, graph.edges.information)
    return PoseGraph(graph.ids, graph.T, edges, graph.fixed), np.isin(np.arange(len(edges)), wrong)


def _torus(count: int, per_turn: int) -> Array:
    """Poses along a spiral around a torus, heading along it; neighbours are about a metre apart."""
    around = 2 * np.pi * np.arange(count) / per_turn
    along = 2 * np.pi * np.arange(count) / count
    minor = per_turn / (2 * np.pi)
    major = max(count / per_turn / (2 * np.pi), 2.0 * minor)
    zero = np.zeros(count)
    about_axis = exponentials(np.stack([zero, zero, along, zero, zero, zero], axis=1))
    out = exponentials(np.stack([zero, zero, zero, zero + major, zero, zero], axis=1))
    about_tube = exponentials(np.stack([zero, around, zero, zero, zero, zero], axis=1))
    rim = exponentials(np.stack([zero, zero, zero, zero + minor, zero, zero], axis=1))
    return about_axis @ out @ about_tube @ rim
