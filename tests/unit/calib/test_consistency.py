"""Edges judged by each other: false ones are dropped with a reason."""

from dataclasses import replace

import numpy as np
import pytest

from rig_calib import consistency
from rig_calib.consistency import consistent_graph, unconfirmed
from rig_calib.edges import Edge
from rig_protocol.poses import Pose, inverse, se3_exp
from rig_protocol.rig_folder import RingDrawing
from support.synthetic_rig import pose_distance

TRUTH = {c: RingDrawing().T_rig_camera(c) for c in range(12)}
RING = [(c, c + 1) for c in range(11)] + [(0, 11)]
COVARIANCE = np.diag(np.repeat([np.deg2rad(0.2), 0.006], 3) ** 2)
FALSE = se3_exp(np.array([0.1, 0.05, 0.0, 0.1, 0.0, 0.05]))


def edge(i: int, j: int, error: Pose | None = None) -> Edge:
    rng = np.random.default_rng([i, j])
    sigma = np.repeat([np.deg2rad(0.2), 0.006], 3)
    T = inverse(TRUTH[i]) @ TRUTH[j] @ se3_exp(sigma * rng.standard_normal(6))
    T = T if error is None else T @ error
    return Edge(i, j, np.zeros((50, 2), np.intp), np.ones(50, bool), T, COVARIANCE, 5.0)


def dropped(edges: tuple[Edge, ...]) -> dict[tuple[int, int], str]:
    return {e.pair: e.reason for e in edges if e.reason is not None}


def test_a_false_edge_among_many_is_dropped_and_says_by_how_much() -> None:
    pairs = [*RING, (0, 2), (3, 5), (2, 4), (6, 8), (1, 11)]
    edges = [edge(i, j, FALSE if (i, j) == (3, 5) else None) for i, j in pairs]
    graph = consistent_graph(edges, range(12), {}, seed=0)
    assert list(dropped(graph.edges)) == [(3, 5)]
    assert "contradicts the other edges by 6." in dropped(graph.edges)[3, 5]
    assert len(graph.poses) == 12
    deg, mm = pose_distance(inverse(TRUTH[0]) @ TRUTH[6], inverse(graph.poses[0]) @ graph.poses[6])
    assert deg < 1.5
    assert mm < 30


def test_a_third_of_false_edges_is_dropped() -> None:
    pairs = [(i, j) for i in range(8) for j in range(i + 1, 8)]
    rng = np.random.default_rng(0)
    false = {pairs[k] for k in rng.permutation(len(pairs))[: len(pairs) // 3]}
    edges = [edge(i, j, se3_exp(rng.normal(0, 0.5, 6)) if (i, j) in false else None) for i, j in pairs]
    assert set(dropped(consistent_graph(edges, range(8), {}, seed=0).edges)) == false


def test_in_a_single_ring_the_drawing_tells_which_edge_is_false() -> None:
    edges = [edge(i, j, FALSE if (i, j) == (4, 5) else None) for i, j in RING]
    graph = consistent_graph(edges, range(12), TRUTH, seed=0)
    assert list(dropped(graph.edges)) == [(4, 5)]
    assert graph.ambiguous == ()


def test_in_a_single_ring_without_a_drawing_nobody_can_tell() -> None:
    edges = [edge(i, j, FALSE if (i, j) == (4, 5) else None) for i, j in RING]
    graph = consistent_graph(edges, range(12), {}, seed=0)
    assert len(graph.ambiguous) == 1


def test_a_knocked_camera_contradicts_the_drawing_but_no_edge() -> None:
    drawing = TRUTH | {7: TRUTH[7] @ se3_exp(np.array([0.07, 0, 0, 0, 0.03, 0]))}
    graph = consistent_graph([edge(i, j) for i, j in RING], range(12), drawing, seed=0)
    assert dropped(graph.edges) == {}


def test_only_the_largest_group_is_placed() -> None:
    graph = consistent_graph([edge(0, 1), edge(1, 2), edge(6, 7)], range(12), {}, seed=0)
    assert sorted(graph.poses) == [0, 1, 2]
    assert dropped(graph.edges) == {}


def test_no_edge_at_all_places_one_camera() -> None:
    assert list(consistent_graph([], [4, 5], {}, seed=0).poses) == [4]


def test_edges_outside_every_loop_are_unconfirmed() -> None:
    assert unconfirmed([(0, 1), (1, 2), (0, 2), (2, 3)], range(4)) == [(2, 3)]
    assert unconfirmed(RING, range(12)) == []


def test_imprecise_edges_that_the_drawing_confirms_are_kept() -> None:
    """Each edge is 1 degree and 20 mm off the same way, which adds up over the ring; none is false."""
    bias = se3_exp(np.array([np.deg2rad(1.0), 0, 0, 0.02, 0, 0]))
    edges = [edge(i, j, bias) for i, j in RING]
    assert dropped(consistent_graph(edges, range(12), TRUTH, seed=0).edges) == {}


def test_edges_that_outnumber_a_false_one_place_their_camera_whatever_tree_starts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The only tree that is tried hangs camera 5 on the false edge, which claims to be the best."""
    monkeypatch.setattr(consistency, "_TREES", 1)
    chain = [edge(i, i + 1) for i in range(4)] + [edge(i, i + 2) for i in range(3)]
    confident = replace(edge(4, 5, FALSE), covariance=COVARIANCE / 100)
    graph = consistent_graph([*chain, confident, edge(3, 5), edge(2, 5)], range(6), {}, seed=0)
    assert list(dropped(graph.edges)) == [(4, 5)]
    assert pose_distance(inverse(TRUTH[0]) @ TRUTH[5], graph.poses[5])[0] < 1.5
