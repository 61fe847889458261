"""Pose graphs solved as a whole: bad starts, wrong edges, parts, the public benchmark, the command."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import rig_calib.pose_graph.block_matrix as block_matrix
from rig_calib.pose_graph.edge_batch import EdgeBatch
from rig_calib.pose_graph.g2o import PoseGraph, read_g2o, write_g2o
from rig_calib.pose_graph.se3_batches import exponentials, inverses, logarithms
from rig_calib.pose_graph.short_cycles import on_agreeing_cycle
from rig_calib.pose_graph.solution import solve
from support.pose_graphs import spiral, with_wrong_edges
from support.real_data import real_data
from support.rig_processes import run_program

Array = npt.NDArray[np.float64]


def errors(T: Array, truth: Array) -> Array:
    """Angle in rad and distance in metres (N,2) from the truth, first poses aligned."""
    aligned = truth[0] @ inverses(T[:1])[0] @ T
    delta = logarithms(inverses(truth) @ aligned)
    return np.stack([np.linalg.norm(delta[:, :3], axis=1), np.linalg.norm(delta[:, 3:], axis=1)], axis=1)


def test_a_map_whose_odometry_drifted_away_is_solved_and_certified() -> None:
    graph, truth = spiral(300, per_turn=12)
    solution = solve(graph)
    assert errors(graph.T, truth)[:, 1].max() > 1.0
    assert errors(solution.graph.T, truth)[:, 1].max() < 0.5
    assert solution.objective == "chordal"
    assert solution.certificate.certified
    # Six numbers an edge minus six a pose, the expectation of a χ² sum.
    freedom = 6 * (len(graph.edges) - len(graph.ids) + 1)
    assert solution.after["chordal"] == pytest.approx(freedom, rel=0.1)


def test_exact_edges_are_met_from_poses_that_say_nothing() -> None:
    graph, truth = spiral(80, per_turn=10, sigma=np.full(6, 1e-9))
    graph = replace(graph.with_poses(np.tile(np.eye(4), (80, 1, 1))))
    assert errors(solve(graph).graph.T, truth).max() < 1e-6


def test_full_information_decides_when_it_differs_by_direction() -> None:
    """Two measurements of one pose, each sharp in one direction only: each direction follows its own."""
    information = np.tile(np.eye(6), (2, 1, 1))
    information[0, 3, 3] = information[1, 4, 4] = 1e6
    moves = np.array([[0, 0, 0, 1.0, 5.0, 0], [0, 0, 0, 3.0, 2.0, 0]])
    edges = EdgeBatch(np.zeros(2, int), np.ones(2, int), exponentials(moves), information)
    graph = PoseGraph((0, 1), np.tile(np.eye(4), (2, 1, 1)), edges, np.zeros(2, dtype=bool))
    solution = solve(graph)
    assert solution.objective == "geodesic"
    np.testing.assert_allclose(solution.graph.T[1, :2, 3], [1.0, 2.0], atol=1e-4)


def test_repeated_edges_share_the_pose_by_their_information() -> None:
    information = np.array([1.0, 3.0])[:, None, None] * np.eye(6)
    moves = np.array([[0, 0, 0, 1.0, 0, 0], [0, 0, 0, 2.0, 0, 0]])
    edges = EdgeBatch(np.array([0, 1]), np.array([1, 0]), exponentials(moves * [[1], [-1]]), information)
    graph = PoseGraph((0, 1), np.tile(np.eye(4), (2, 1, 1)), edges, np.zeros(2, dtype=bool))
    assert solve(graph).graph.T[1, 0, 3] == pytest.approx(1.75)


def test_fixed_poses_and_the_first_of_a_part_without_one_stay() -> None:
    graph, _ = spiral(40, per_turn=6)
    edges = graph.edges
    within = (edges.i < 20) == (edges.j < 20)
    parted = PoseGraph(graph.ids, graph.T, edges.select(within), np.arange(40) == 7)
    solved = solve(parted).graph.T
    np.testing.assert_array_equal(solved[[7, 20]], graph.T[[7, 20]])
    assert np.abs(solved[0] - graph.T[0]).max() > 1e-6


def test_conjugate_gradients_find_what_the_factorisation_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, _ = spiral(150, per_turn=12)
    factorised = solve(graph)
    monkeypatch.setattr(block_matrix, "_MAX_OPERATIONS", 0.0)
    iterated = solve(graph)
    assert iterated.after["chordal"] == pytest.approx(factorised.after["chordal"], rel=1e-5)


@pytest.mark.parametrize("seed", [0, 1])
def test_wrong_loop_edges_are_named_and_change_nothing(seed: int) -> None:
    graph, truth = spiral(120, per_turn=12, seed=seed)
    loops = np.flatnonzero(graph.edges.j - graph.edges.i > 1)
    spoilt, wrong = with_wrong_edges(graph, loops, 0.3, seed)
    solution = solve(spoilt, robust=True)
    np.testing.assert_array_equal(solution.kept, ~wrong)
    edges = spoilt.edges
    assert solution.rejected == [(edges.i[k], edges.j[k]) for k in np.flatnonzero(wrong)]
    assert errors(solution.graph.T, truth)[:, 1].max() < 0.6
    assert errors(solve(spoilt).graph.T, truth)[:, 1].max() > 1.0  # plain least squares is led astray


def test_a_rig_of_all_pairs_loses_its_wrong_edges_whichever_they_are() -> None:
    """Twelve cameras, no odometry to trust: any pair may be wrong, neighbours included."""
    rng = np.random.default_rng(4)
    truth = exponentials(rng.standard_normal((12, 6)))
    i, j = np.triu_indices(12, k=1)
    sigma = np.repeat([0.005, 0.01], 3)
    measured = inverses(truth[i]) @ truth[j] @ exponentials(sigma * rng.standard_normal((len(i), 6)))
    edges = EdgeBatch(i, j, measured, np.tile(np.diag(sigma**-2.0), (len(i), 1, 1)))
    graph = PoseGraph(tuple(range(12)), np.tile(np.eye(4), (12, 1, 1)), edges, np.zeros(12, dtype=bool))
    spoilt, wrong = with_wrong_edges(graph, np.arange(len(i)), 0.3)
    np.testing.assert_array_equal(solve(spoilt, robust=True).kept, ~wrong)


def test_nothing_is_rejected_where_nothing_is_wrong() -> None:
    graph, _ = spiral(200, per_turn=12)
    plain, robust = solve(graph), solve(graph, robust=True)
    assert robust.kept.all()
    assert robust.after["chordal"] == pytest.approx(plain.after["chordal"], rel=1e-6)


def test_wrong_edges_close_no_short_cycle() -> None:
    graph, _ = spiral(200, per_turn=12)
    spoilt, wrong = with_wrong_edges(graph, np.arange(len(graph.edges)), 0.3)
    agreeing = on_agreeing_cycle(spoilt.edges)
    assert not agreeing[wrong].any()
    assert agreeing[~wrong].mean() > 0.5


@pytest.mark.parametrize(("name", "optimum"), [("sphere2500", 1.687e3)])
def test_the_public_benchmark_is_solved_to_its_certified_optimum(name: str, optimum: float) -> None:
    """README of the folder: SE-Sync's optimum. GTSAM, with another objective, ends 2.5 % above it."""
    solution = solve(read_g2o(real_data("pose_graphs") / f"{name}.g2o"))
    assert solution.after["chordal"] == pytest.approx(optimum, rel=1e-3)
    assert solution.certificate.certified


def test_the_command_writes_the_graph_names_wrong_edges_and_prints_json_alone(tmp_path: Path) -> None:
    graph, _ = spiral(60, per_turn=8)
    loops = np.flatnonzero(graph.edges.j - graph.edges.i > 1)
    spoilt, wrong = with_wrong_edges(graph, loops, 0.1)
    write_g2o(tmp_path / "in.g2o", spoilt)
    command = ("rig_calib.cli", "pose-graph", tmp_path / "in.g2o", "--out", tmp_path / "out.g2o", "--robust")
    told = run_program(*command)
    assert told.returncode == 0, told.stderr
    assert "certified" in told.stdout
    solution = json.loads(run_program(*command, "--json").stdout)
    assert [edge["edge"] for edge in solution["rejected"]] == np.flatnonzero(wrong).tolist()
    assert solution["objective"] == "chordal"
    written = read_g2o(tmp_path / "out.g2o")
    kept = written.edges.select(~wrong).isotropic()
    assert kept.squared_distances(written.T, "chordal").sum() == pytest.approx(solution["after"]["chordal"])


def test_of_edges_that_only_contradict_each_other_one_is_kept() -> None:
    """Two measurements of one pose, far apart and equally sure: it must not be left without any."""
    moves = np.array([[0, 0, 0, 1.0, 0, 0], [0, 0, 0, 9.0, 0, 0]])
    information = np.tile(100 * np.eye(6), (2, 1, 1))
    edges = EdgeBatch(np.zeros(2, int), np.ones(2, int), exponentials(moves), information)
    graph = PoseGraph((0, 1), np.tile(np.eye(4), (2, 1, 1)), edges, np.zeros(2, dtype=bool))
    solution = solve(graph, robust=True)
    assert solution.kept.sum() == 1
    assert solution.graph.T[1, 0, 3] == pytest.approx(moves[solution.kept, 3].item())


def test_a_torn_file_ends_the_command_with_the_line(tmp_path: Path) -> None:
    (tmp_path / "torn.g2o").write_text("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nEDGE_SE3:QUAT 0 1 1 0")
    done = run_program("rig_calib.cli", "pose-graph", tmp_path / "torn.g2o", "--out", tmp_path / "out.g2o")
    assert done.returncode == 1
    assert "line 2" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out.g2o").exists()
