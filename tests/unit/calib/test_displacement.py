"""Displacements are what sampled poses show, and are told on the axes of the room however cameras lie."""

from dataclasses import replace

import numpy as np
import pytest

from rig_calib.displacement import (
    PairUncertainty,
    least_certain,
    overlaps,
    pair_frame,
    pair_uncertainties,
    worst_pair,
)
from rig_calib.rig_calibration import CalibratedEdge
from rig_protocol.poses import Pose, inverse, se3_exp, transform_points
from support.box_room import calibration_of, ring_poses

POSES = ring_poses()
VIEW = np.eye(4)  # of the ring's frame: z up


def pair(covariance: np.ndarray, i: int = 0, j: int = 1, poses: dict[int, Pose] = POSES) -> PairUncertainty:
    return PairUncertainty.of(i, j, poses[i], poses[j], covariance)


def in_camera(room: np.ndarray, i: int = 0, j: int = 1) -> np.ndarray:
    """A covariance on the axes of the room (forward, left, up) as one on the right of T_i_j."""
    R = POSES[j][:3, :3].T @ pair_frame(POSES[i], POSES[j])[:3, :3]
    turn = np.kron(np.eye(2), R)
    return turn @ room @ turn.T


def edge(i: int, j: int, used: bool = True, covariance: np.ndarray | None = None) -> CalibratedEdge:
    return CalibratedEdge(i, j, 100, 80, 3.0, inverse(POSES[i]) @ POSES[j], used, None, covariance)


def test_displacements_are_those_of_sampled_relative_poses() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(0, 1e-3, (6, 6))
    covariance = root @ root.T
    T_rig_pair = pair_frame(POSES[0], POSES[1])
    points = transform_points(T_rig_pair, np.array([(3, 0, 3 * np.tan(np.deg2rad(a))) for a in (-20, 0, 20)]))
    in_j = transform_points(inverse(POSES[1]), points)
    samples = rng.multivariate_normal(np.zeros(6), covariance, 4000)
    moved = np.array([transform_points(se3_exp(delta), in_j) - in_j for delta in samples])
    measured = np.sqrt((moved**2).sum(axis=2).mean()) * 1e3
    assert pair(covariance).displacement_mm(3.0) == pytest.approx(measured, rel=0.05)


@pytest.mark.parametrize(
    ("axis", "sigma", "told"),
    [
        (1, np.deg2rad(0.1), "nodding up and down (0.10°)"),
        (2, np.deg2rad(0.08), "turning about the vertical axis (0.08°)"),
        (3, 0.004, "sliding along the viewing direction (4.0 mm)"),
        (4, 0.003, "sliding sideways (3.0 mm)"),
        (5, 0.002, "sliding up and down (2.0 mm)"),
    ],
)
def test_the_weakest_motion_is_told_in_the_rooms_terms(axis: int, sigma: float, told: str) -> None:
    """The cameras lie on their side: a turn about the vertical axis is one about their image's x."""
    variances = np.full(6, 1e-12)
    variances[axis] = sigma**2
    assert str(pair(in_camera(np.diag(variances))).weakest_motion(3.0)) == told


def test_a_roll_moves_what_is_above_and_below_the_middle() -> None:
    rolled = np.diag([np.deg2rad(0.5) ** 2, 0, 0, 0, 0, 0])
    known = pair(in_camera(rolled))
    assert str(known.weakest_motion(3.0)) == "rolling about the viewing direction (0.50°)"
    assert known.displacement_mm(3.0) == pytest.approx(
        np.deg2rad(0.5) * 3e3 * np.tan(np.deg2rad(20)) * 0.816, 0.1
    )


def test_a_turn_displaces_in_proportion_to_the_distance_and_a_slide_does_not() -> None:
    turning = pair(in_camera(np.diag([0, 0, np.deg2rad(0.1) ** 2, 0, 0, 0])))
    sliding = pair(in_camera(np.diag([0, 0, 0, 0, 1e-6, 0])))
    assert turning.displacement_mm(4.0) == pytest.approx(2 * turning.displacement_mm(2.0), rel=0.1)
    assert sliding.displacement_mm(4.0) == pytest.approx(1.0)
    assert sliding.displacement_mm(1.0) == pytest.approx(1.0)


def test_a_turn_and_a_slide_that_undo_each_other_at_a_distance_displace_nothing_there() -> None:
    """Correlation is what matters: points were matched at 2 m, and there both cameras agree."""
    lever = pair(np.eye(6)).T_room_j[:3, 3]
    motion = np.zeros(6)
    motion[2] = np.deg2rad(0.2)
    motion[3:] = -np.cross(motion[:3], np.array([2.0, 0, 0]) - lever)
    known = pair(in_camera(np.outer(motion, motion)))
    assert known.displacement_mm(2.0) < 0.01 * known.displacement_mm(4.0)


def test_overlaps_are_told_around_the_ring_and_the_worst_one_is_found() -> None:
    small, large = np.eye(6) * 1e-8, np.eye(6) * 1e-6
    edges = (edge(6, 7, covariance=small), edge(0, 1, covariance=small), edge(3, 4, covariance=large))
    pairs = pair_uncertainties(calibration_of(POSES, edges=edges), VIEW)
    assert [(known.i, known.j) for known in pairs] == [(0, 1), (3, 4), (6, 7)]
    worst = worst_pair(pairs, 3.0)
    assert worst is not None
    assert (worst.i, worst.j) == (3, 4)
    assert least_certain(pairs) is worst
    assert least_certain(pairs[:1]) is None
    assert worst_pair([], 3.0) is None


def test_neighbours_whose_edge_failed_are_overlaps_and_cameras_far_apart_are_not() -> None:
    edges = (edge(0, 1, used=False), edge(0, 3, used=False), edge(0, 2))
    found = overlaps(calibration_of(POSES, edges=edges))
    assert [(item.i, item.j) for item in found] == [(0, 1), (0, 2)]
    unplaced = calibration_of({k: T for k, T in POSES.items() if k != 1}, edges=edges)
    assert [(item.i, item.j) for item in overlaps(unplaced)] == [(0, 2)]


def test_edges_without_a_covariance_state_nothing() -> None:
    calibration = calibration_of(POSES, edges=(edge(0, 1),))
    assert pair_uncertainties(calibration, VIEW) == []
    known = replace(calibration, edges=(edge(0, 1, covariance=np.eye(6)),))
    assert len(pair_uncertainties(known, VIEW)) == 1


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)])
def test_cameras_that_look_straight_up_or_down_have_axes_all_the_same(
    axis: tuple[float, float, float],
) -> None:
    T = np.eye(4)
    T[:3, :3] = np.column_stack([(1, 0, 0), np.cross(axis, (1, 0, 0)), axis])
    R = pair_frame(T, T)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R[:, 0], axis)


def test_cameras_back_to_back_have_axes_all_the_same() -> None:
    R = pair_frame(POSES[0], POSES[6])[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
