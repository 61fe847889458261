"""The certificate: given to global optima, refused to others, its bound below every pose's objective."""

import numpy as np
import numpy.typing as npt

from rig_calib.pose_graph.block_matrix import BlockPattern
from rig_calib.pose_graph.edge_batch import EdgeBatch
from rig_calib.pose_graph.optimality import certify
from rig_calib.pose_graph.optimiser import minimise
from rig_calib.pose_graph.se3_batches import exponentials
from support.pose_graphs import spiral

Array = npt.NDArray[np.float64]


def optimum(start: Array, edges: EdgeBatch) -> Array:
    free = np.arange(len(start)) > 0
    pattern = BlockPattern(edges.i, edges.j, free)
    return minimise(start, edges.isotropic(), pattern, "chordal")[0]


def circle(count: int, turns: int) -> tuple[Array, EdgeBatch]:
    """A closed walk of one turn, and poses that satisfy it but for that they turn `turns` times."""
    i = np.arange(count)
    step, wrong = (np.array([[0, 0, angle / count, 1.0, 0, 0]]) for angle in (2 * np.pi, 2 * np.pi * turns))
    information = np.tile(100 * np.eye(6), (count, 1, 1))
    edges = EdgeBatch(i, (i + 1) % count, np.repeat(exponentials(step), count, axis=0), information)
    T = np.tile(np.eye(4), (count, 1, 1))
    for k in i[1:]:
        T[k] = T[k - 1] @ exponentials(wrong)[0]
    return T, edges


def test_a_global_optimum_is_certified() -> None:
    for count in (20, 150):  # dense and sparse
        graph, truth = spiral(count, per_turn=6, seed=count)
        certificate = certify(optimum(truth, graph.edges), graph.edges)
        assert certificate.certified
        assert certificate.gap is not None
        assert certificate.gap < 1e-5
        assert certificate.eigenvalue is not None
        assert abs(certificate.eigenvalue) < 1e-3


def test_a_twisted_circle_is_a_local_optimum_and_not_certified() -> None:
    start, edges = circle(20, turns=0)
    twisted = optimum(start, edges)
    pattern = BlockPattern(edges.i, edges.j, np.arange(20) > 0)
    part = edges.isotropic().linearised(twisted, "chordal")
    assert np.abs(pattern.vector(part.i, part.j)).max() < 1e-3 * np.abs(part.i).max()  # it is an optimum
    certificate = certify(twisted, edges)
    assert not certificate.certified
    assert certificate.eigenvalue is not None
    assert certificate.eigenvalue < -1.0


def test_the_untwisted_circle_is_certified_although_its_objective_is_zero() -> None:
    start, edges = circle(20, turns=1)
    certificate = certify(start, edges)
    assert certificate.certified
    assert certificate.objective < 1e-12


def test_no_poses_undercut_the_bound_wherever_it_was_taken() -> None:
    graph, truth = spiral(30, per_turn=6, seed=2)
    best = float(graph.edges.isotropic().squared_distances(optimum(truth, graph.edges), "chordal").sum())
    rng = np.random.default_rng(0)
    for scale in (0.01, 0.1, 1.0):
        elsewhere = truth @ exponentials(scale * rng.standard_normal((30, 6)))
        certificate = certify(elsewhere, graph.edges)
        assert certificate.lower_bound is not None
        assert certificate.lower_bound <= best * (1 + 1e-9)
        assert certificate.objective > best


def test_a_graph_in_parts_is_certified_as_a_whole() -> None:
    graph, truth = spiral(20, per_turn=6)
    edges = graph.edges
    twice = EdgeBatch(
        *(
            np.concatenate(both)
            for both in (
                (edges.i, edges.i + 20),
                (edges.j, edges.j + 20),
                (edges.T_i_j, edges.T_i_j),
                (edges.information, edges.information),
            )
        )
    )
    T = optimum(truth, edges)
    assert certify(np.concatenate([T, T]), twice).certified
