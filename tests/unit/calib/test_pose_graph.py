"""Pose graphs: exact recovery, loops closed by information, trees and groups."""

import numpy as np
import pytest

from rig_calib.loops import closing_cycle
from rig_calib.pose_graph import (
    PoseEdge,
    chain_poses,
    connected_groups,
    edge_residual,
    loop_error,
    optimise,
    spanning_tree,
)
from rig_protocol.poses import Pose, adjoint, inverse, se3_exp, se3_log
from rig_protocol.rig_folder import RingDrawing

TRUTH = {c: RingDrawing().T_rig_camera(c) for c in range(12)}
RING = [(c, (c + 1) % 12) for c in range(12)]
UNIT = np.eye(6)


def edges_of(pairs: list[tuple[int, int]], noise: float = 0.0, seed: int = 0) -> list[PoseEdge]:
    rng = np.random.default_rng(seed)
    return [
        PoseEdge(i, j, inverse(TRUTH[i]) @ TRUTH[j] @ se3_exp(noise * rng.standard_normal(6)), UNIT)
        for i, j in pairs
    ]


def same(a: Pose, b: Pose, atol: float = 1e-8) -> bool:
    return bool(np.abs(se3_log(inverse(a) @ b)).max() < atol)


def test_exact_edges_give_exact_poses_from_a_rough_start() -> None:
    rng = np.random.default_rng(1)
    start = {c: T @ se3_exp(0.2 * rng.standard_normal(6) * (c > 0)) for c, T in TRUTH.items()}
    result = optimise(start, edges_of([*RING, (0, 6), (3, 9)]), [0])
    assert all(same(result.poses[c], TRUTH[c]) for c in TRUTH)
    assert result.cost < 1e-15


def test_closing_the_loop_shares_the_error_among_the_edges() -> None:
    edges = edges_of(RING, noise=0.01)
    chain = chain_poses(edges[:-1], 0, TRUTH[0])
    result = optimise(chain, edges, [0])
    open_error = np.linalg.norm(edge_residual(edges[-1], chain))
    residuals = [np.linalg.norm(edge_residual(edge, result.poses)) for edge in edges]
    assert max(residuals) < 0.4 * open_error
    assert all(np.linalg.norm(edge_residual(edge, chain)) < 1e-12 for edge in edges[:-1])


def test_an_uncertain_edge_takes_the_loops_error() -> None:
    edges = edges_of(RING)
    vague = PoseEdge(5, 6, edges[5].T_i_j @ se3_exp(np.full(6, 0.05)), 1e-6 * UNIT)
    result = optimise(TRUTH, [*edges[:5], vague, *edges[6:]], [0])
    assert all(same(result.poses[c], TRUTH[c], 1e-4) for c in TRUTH)


def test_the_residual_is_the_edges_error_on_its_right() -> None:
    delta = np.array([0.02, -0.01, 0.03, 0.004, 0.005, -0.006])
    edge = edges_of([(2, 7)])[0]
    moved = TRUTH | {7: TRUTH[2] @ edge.T_i_j @ se3_exp(delta)}
    np.testing.assert_allclose(edge_residual(edge, moved), delta, atol=1e-12)


def test_the_gradient_vanishes_at_the_optimum() -> None:
    """Numeric derivatives of the cost, which know nothing of the analytic ones."""
    edges = edges_of([*RING, (0, 5), (2, 8)], noise=0.05)
    result = optimise(TRUTH, edges, [0])

    def cost(poses: dict[int, Pose]) -> float:
        return sum(0.5 * float(r @ r) for r in (edge_residual(edge, poses) for edge in edges))

    for node in (1, 5, 11):
        for delta in 1e-5 * np.eye(6):
            ahead, behind = (
                cost({**result.poses, node: result.poses[node] @ se3_exp(s * delta)}) for s in (1, -1)
            )
            assert abs(ahead - behind) / 2e-5 < 2e-4


def test_the_normal_matrix_is_that_of_the_edges() -> None:
    edge = edges_of([(0, 1)])[0]
    information = np.diag([1.0, 2, 3, 4, 5, 6])
    result = optimise(TRUTH, [PoseEdge(1, 0, inverse(edge.T_i_j), information)], [0])
    Ad = adjoint(inverse(TRUTH[0]) @ TRUTH[1])
    assert result.order == tuple(range(1, 12))
    np.testing.assert_allclose(result.normal.toarray()[:6, :6], Ad.T @ information @ Ad, atol=1e-8)


def test_the_spanning_tree_is_the_cheapest_and_starts_all_poses() -> None:
    edges = edges_of([*RING, (0, 6)])
    tree = spanning_tree(edges, [1.0] * 5 + [50.0] + [1.0] * 6 + [9.0])
    assert len(tree) == 11
    assert (5, 6) not in {(edge.i, edge.j) for edge in tree}
    poses = chain_poses(tree, 3, TRUTH[3])
    assert all(same(poses[c], TRUTH[c]) for c in TRUTH)


def test_a_graph_in_parts_has_a_forest_and_its_groups_are_listed_largest_first() -> None:
    pairs = [(0, 1), (1, 2), (7, 8)]
    assert len(spanning_tree(edges_of(pairs), [1.0] * 3)) == 3
    assert connected_groups([0, 1, 2, 5, 7, 8], pairs) == [[0, 1, 2], [7, 8], [5]]


def test_a_cycle_of_exact_poses_closes_in_either_direction() -> None:
    relative = {(e.i, e.j): e.T_i_j for e in edges_of(RING)}
    assert loop_error(list(range(12)), relative) == pytest.approx((0, 0), abs=1e-6)
    assert loop_error(list(range(11, -1, -1)), relative) == pytest.approx((0, 0), abs=1e-6)


def test_the_loop_error_is_told_in_degrees_and_millimetres() -> None:
    relative = {(e.i, e.j): e.T_i_j for e in edges_of(RING)}
    relative[11, 0] = relative[11, 0] @ se3_exp(np.array([0.0, np.deg2rad(2.0), 0, 0, 0, 0.0]))
    assert loop_error(list(range(12)), relative)[0] == pytest.approx(2.0)


def test_the_closing_cycle_of_a_ring_is_the_ring() -> None:
    cycle = closing_cycle([(min(p), max(p)) for p in RING])
    assert cycle is not None
    assert sorted(cycle) == list(range(12))
    assert closing_cycle([(0, 1), (1, 2)]) is None
    assert closing_cycle([]) is None
