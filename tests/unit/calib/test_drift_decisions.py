"""Rules of the drift watch's decisions, without images: who moved, when that is said, and when it is not."""

import numpy as np
import numpy.typing as npt
import pytest

from rig_calib.drift.hypotheses import EdgeEvidence, moved_cameras, support
from rig_calib.drift.motion import Measurements, Motion, estimate_motion, pixel_jacobian
from rig_calib.drift.movement_test import MovementTest
from rig_calib.drift.rig_motion import motion_in_rig, rig_motion
from rig_protocol.camera import DEFAULT_COLOR
from rig_protocol.poses import adjoint, inverse
from support.box_room import ring_poses

Array = npt.NDArray[np.float64]

POSES = ring_poses(12)
TURN = np.array([0.0, np.deg2rad(0.5), 0.0, 0.0, 0.0, 0.0])
SHIFT = np.array([0.0, 0.0, 0.0, 0.003, 0.004, 0.0])
SHARP = np.diag(np.repeat([np.deg2rad(0.005), 0.0003], 3) ** -2.0)
EDGE_COVARIANCE = np.diag(np.repeat([np.deg2rad(0.05), 0.001], 3) ** 2)


@pytest.fixture
def points() -> Array:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-1, 1, (200, 2)), rng.uniform(1.5, 3, 200)])


def edges(moved: dict[int, Array], cameras: int = 12) -> list[EdgeEvidence]:
    """What the overlaps of a closed ring show when cameras moved."""
    shown = []
    for i in range(cameras):
        j = (i + 1) % cameras
        T_j_i = inverse(POSES[j]) @ POSES[i]
        nothing = np.zeros(6)
        delta = moved.get(j, nothing) - adjoint(T_j_i) @ moved.get(i, nothing)
        shown.append(EdgeEvidence(i, j, T_j_i, delta, EDGE_COVARIANCE))
    return shown


@pytest.mark.parametrize("motion", [TURN, 2 * SHIFT])
def test_the_camera_whose_motion_explains_both_its_overlaps_is_named(motion: Array) -> None:
    found = moved_cameras(edges({4: motion}), threshold=40.0)
    assert [one.camera for one in found] == [4]
    assert np.allclose(found[0].delta, motion, atol=1e-5)


def test_two_moved_cameras_are_both_named() -> None:
    found = moved_cameras(edges({2: TURN, 7: 3 * SHIFT}), threshold=40.0)
    assert sorted(one.camera for one in found) == [2, 7]


def test_one_overlap_against_all_others_is_a_wrong_overlap_and_no_moved_camera() -> None:
    shown = edges({})
    shown[3] = EdgeEvidence(3, 4, shown[3].T_j_i, TURN, EDGE_COVARIANCE)
    assert moved_cameras(shown, threshold=40.0) == []


def test_with_one_overlap_alone_the_other_camera_is_a_rival() -> None:
    found = moved_cameras(edges({1: 2 * TURN})[:1], threshold=40.0)
    assert len(found) == 1
    assert {found[0].camera, *found[0].rivals} == {0, 1}


def test_overlaps_that_stay_contradict_a_view_that_moved_and_overlaps_that_follow_support_it() -> None:
    assert support(edges({}), 4, TURN) < -9
    assert support(edges({4: TURN}), 4, TURN) > 9


def test_a_bump_is_told_after_some_looks_and_not_after_one(points: Array) -> None:
    test = MovementTest(points, 12)
    test.add(Motion(SHIFT, SHARP, 1.0))
    assert not test.moved
    for _ in range(9):
        test.add(Motion(SHIFT, SHARP, 1.0))
    assert test.moved
    assert np.allclose(test.estimate[0], SHIFT, atol=1e-6)


def test_who_passes_by_disturbs_looks_and_raises_no_alarm(points: Array) -> None:
    """Four looks in a row are off by far more than a bump; then the view is free for as long."""
    test = MovementTest(points, 12)
    for k in range(400):
        delta = 5 * TURN if k % 8 < 4 else np.zeros(6)
        test.add(Motion(delta, SHARP, 1.0))
        assert not test.moved


def test_a_camera_that_is_put_back_is_in_its_place_again(points: Array) -> None:
    test = MovementTest(points, 12)
    for delta in [SHIFT] * 20 + [np.zeros(6)] * 20:
        test.add(Motion(delta, SHARP, 1.0))
    assert not test.moved


def test_a_view_that_says_little_raises_no_alarm_however_large_its_estimate(points: Array) -> None:
    rng = np.random.default_rng(1)
    vague = np.diag(np.repeat([np.deg2rad(1.0), 0.04], 3) ** 2)
    test = MovementTest(points, 12)
    for _ in range(500):
        test.add(Motion(rng.multivariate_normal(np.zeros(6), vague), np.linalg.inv(vague), 1.0))
        assert not test.moved


def test_a_rig_that_is_pushed_moved_no_camera_in_it() -> None:
    push = np.array([0.002, -0.003, 0.01, 0.01, 0.02, -0.005])
    motions = {k: Motion(motion_in_rig(push, T), SHARP, 1.0) for k, T in POSES.items()}
    assert np.allclose(rig_motion(motions, POSES), push, atol=1e-6)


def test_cameras_that_stayed_outvote_one_that_moved() -> None:
    motions = {k: Motion(4 * TURN if k == 3 else np.zeros(6), SHARP, 1.0) for k in POSES}
    assert np.abs(rig_motion(motions, POSES)).max() < 2e-4


def test_a_motion_is_estimated_though_a_third_of_the_measurements_are_wrong(points: Array) -> None:
    rng = np.random.default_rng(2)
    jacobian = pixel_jacobian(DEFAULT_COLOR, points) / 0.3
    residual = jacobian @ SHIFT + rng.standard_normal((len(points), 2))
    residual[::3] += rng.uniform(20, 60, (len(residual[::3]), 2))
    motion = estimate_motion((Measurements(residual, jacobian, rows=2),))
    assert motion is not None
    assert motion.agreement < 0.75
    sigma = np.sqrt(np.diag(np.linalg.inv(motion.information)))
    assert (np.abs(motion.delta - SHIFT) < 4 * sigma).all()
