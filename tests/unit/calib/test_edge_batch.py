"""The two objectives of a pose graph: their values and their derivatives."""

import numpy as np
import pytest

from rig_calib.pose_graph.edge_batch import EdgeBatch, Objective
from rig_calib.pose_graph.se3_batches import exponentials
from support.pose_graphs import spiral

OBJECTIVES: tuple[Objective, ...] = ("geodesic", "chordal")


def skewed_edges() -> tuple[EdgeBatch, np.ndarray]:
    """Edges with full, different information matrices, at poses where they disagree by a radian or so."""
    rng = np.random.default_rng(5)
    graph, truth = spiral(12, per_turn=4)
    roots = np.tril(rng.standard_normal((len(graph.edges), 6, 6))) + 2 * np.eye(6)
    edges = EdgeBatch(graph.edges.i, graph.edges.j, graph.edges.T_i_j, roots @ roots.transpose(0, 2, 1))
    return edges, truth @ exponentials(0.5 * rng.standard_normal((12, 6)))


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_gradients_are_the_numeric_derivatives_of_the_cost(objective: Objective) -> None:
    edges, T = skewed_edges()
    part, h = edges.linearised(T, objective), 1e-6
    for node in (0, 5, 11):
        gradient = part.i[edges.i == node].sum(axis=0) + part.j[edges.j == node].sum(axis=0)
        for axis in range(6):
            cost = []
            for sign in (1, -1):
                moved = T.copy()
                moved[node] = T[node] @ exponentials(sign * h * np.eye(6)[axis : axis + 1])[0]
                cost.append(0.5 * edges.squared_distances(moved, objective).sum())
            assert (cost[0] - cost[1]) / (2 * h) == pytest.approx(gradient[axis], rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_normal_blocks_are_those_of_the_residuals_numeric_jacobians(objective: Objective) -> None:
    edges, T = skewed_edges()
    part, h = edges.linearised(T, objective), 1e-6

    def jacobian(rows: np.ndarray) -> np.ndarray:
        columns = []
        for axis in np.eye(6)[:, None]:
            sides = []
            for sign in (1, -1):
                E = T.copy()
                E[rows] = T[rows] @ exponentials(sign * h * axis)
                sides.append(edges.residuals(E, objective))
            columns.append((sides[0] - sides[1]) / (2 * h))
        return np.stack(columns, axis=2)

    for k in range(len(edges)):
        by_i, by_j = (jacobian(np.array([node]))[k] for node in (edges.i[k], edges.j[k]))
        weighted = by_i.T @ edges.information[k]
        np.testing.assert_allclose(part.ii[k], weighted @ by_i, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(part.ij[k], weighted @ by_j, rtol=1e-4, atol=1e-4)


def test_the_chordal_distances_are_se_syncs_terms() -> None:
    """Σ κ ‖R_j − R_i R_ij‖² + τ ‖t_j − t_i − R_i t_ij‖² with κ = 3/(2 tr Λ_R⁻¹), τ = 3/tr Λ_t⁻¹."""
    edges, T = skewed_edges()
    for k, distance in enumerate(edges.isotropic().squared_distances(T, "chordal")):
        i, j, measured = T[edges.i[k]], T[edges.j[k]], edges.T_i_j[k]
        kappa = 1.5 / np.trace(np.linalg.inv(edges.information[k, :3, :3]))
        tau = 3.0 / np.trace(np.linalg.inv(edges.information[k, 3:, 3:]))
        rotation = np.linalg.norm(j[:3, :3] - i[:3, :3] @ measured[:3, :3]) ** 2
        translation = np.linalg.norm(j[:3, 3] - i[:3, 3] - i[:3, :3] @ measured[:3, 3]) ** 2
        assert distance == pytest.approx(kappa * rotation + tau * translation)


def test_information_is_nearly_isotropic_up_to_a_factor_and_a_correlation() -> None:
    edges, _ = skewed_edges()

    def nearly(information: np.ndarray) -> bool:
        return EdgeBatch(edges.i[:1], edges.j[:1], edges.T_i_j[:1], information[None]).nearly_isotropic()

    correlated = np.eye(6)
    assert nearly(np.diag([1.0, 2, 9, 1e4, 2e4, 3e4]))
    assert not nearly(np.diag([1.0, 1, 11, 1, 1, 1]))
    correlated[0, 4] = correlated[4, 0] = 0.3
    assert nearly(correlated)
    correlated[0, 4] = correlated[4, 0] = 0.6
    assert not nearly(correlated)
