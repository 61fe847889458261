"""The joint adjustment: derivatives, exact recovery, bias, false matches."""

from dataclasses import replace

import numpy as np
import pytest

from rig_calib.depth_model import depth_grid
from rig_calib.observation_model import CameraState, Observations, jacobians, residuals
from rig_calib.rig_adjustment import adjust_rig
from rig_calib.settings import CalibrationSettings
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import Pose, inverse, se3_exp
from support.synthetic_rig import COLOR, MODEL, SyntheticRig, pose_distance, true_matches

GRID = depth_grid(MODEL, "depth")
DISTORTED = Intrinsics(517.3, 516.5, 318.6, 255.3, dist=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
SETTINGS = CalibrationSettings()


def observations(count: int, seed: int = 0) -> tuple[CameraState, np.ndarray, Observations]:
    """A state, points in front of its camera, and observations that need not fit."""
    rng = np.random.default_rng(seed)
    state = CameraState(se3_exp(rng.normal(0, 0.4, 6)), rng.normal(0, 0.02, 6), np.array([0.004, 0.5, -0.8]))
    points = rng.uniform((-0.6, -0.4, 1.0), (0.6, 0.4, 2.5), (count, 3))
    in_rig = points @ state.T_rig_camera[:3, :3].T + state.T_rig_camera[:3, 3]
    disparity = rng.uniform(700, 900, count)
    disparity[::5] = np.nan
    seen = Observations(
        camera=np.zeros(count, np.intp),
        point=np.arange(count),
        pixels=rng.uniform((0, 0), (640, 480), (count, 2)),
        pixel_sigma=rng.uniform(0.3, 0.6, count),
        disparity=disparity,
        slope=rng.normal(0, 0.5, (count, 2)),
        grid_pixels=rng.uniform((0, 0), (640, 480), (count, 2)),
        disparity_sigma=rng.uniform(0.3, 0.6, count),
    )
    return state, in_rig, seen


def moved(state: CameraState, delta: np.ndarray) -> CameraState:
    return CameraState(
        state.T_rig_camera @ se3_exp(delta[:6]), state.bias + delta[6:12], state.intrinsics + delta[12:]
    )


def neighbours_of(rig: SyntheticRig, **noise: float) -> tuple[dict, dict]:
    cameras = {c: rig.observe(c, **noise) for c in range(rig.cameras)}
    pairs = [(c, c + 1) for c in range(rig.cameras - 1)] + [(0, rig.cameras - 1)] * (rig.cameras == 12)
    return cameras, {(i, j): true_matches(cameras[i], cameras[j]) for i, j in pairs}


def disturbed(rig: SyntheticRig, seed: int = 9) -> dict[int, Pose]:
    """Starts some degrees and centimetres off, in the frame of the first camera."""
    rng = np.random.default_rng(seed)
    sigma = np.repeat([np.deg2rad(1.5), 0.02], 3)
    first = inverse(rig.truth[0])
    return {c: first @ T @ se3_exp(sigma * rng.standard_normal(6) * (c > 0)) for c, T in rig.truth.items()}


@pytest.mark.parametrize("color", [COLOR, DISTORTED])
def test_jacobians_are_the_derivatives(color: Intrinsics) -> None:
    state, points, seen = observations(30)
    by_state, by_point = jacobians(color, GRID, state, points, seen)
    step = 1e-6
    for k, delta in enumerate(step * np.eye(15)):
        ahead, behind = (residuals(color, GRID, moved(state, sign * delta), points, seen) for sign in (1, -1))
        np.testing.assert_allclose(by_state[:, :, k], (ahead - behind) / (2 * step), rtol=1e-4, atol=1e-3)
    for k, shift in enumerate(step * np.eye(3)):
        ahead, behind = (residuals(color, GRID, state, points + sign * shift, seen) for sign in (1, -1))
        np.testing.assert_allclose(by_point[:, :, k], (ahead - behind) / (2 * step), rtol=1e-4, atol=1e-3)


def test_a_point_behind_its_camera_is_never_an_improvement() -> None:
    state, points, seen = observations(5)
    behind = 2 * state.T_rig_camera[:3, 3] - points
    assert np.isinf(residuals(COLOR, GRID, state, behind, seen)).all()


def test_without_noise_poses_are_recovered_exactly() -> None:
    rig = SyntheticRig(cameras=4, points=1200)
    cameras, matches = neighbours_of(rig)
    result = adjust_rig(cameras, matches, disturbed(rig), None, SETTINGS)
    for c, T in rig.truth.items():
        deg, mm = pose_distance(inverse(rig.truth[0]) @ T, result.poses[c])
        assert deg < 1e-3
        assert mm < 0.05


def test_depth_scales_of_the_units_are_found_and_do_not_spoil_the_poses() -> None:
    """2 % of scale, which bends a plain alignment by centimetres, costs a closed ring hardly anything."""
    rig = SyntheticRig(points=2500, bias=0.02)
    cameras, matches = neighbours_of(rig, pixel_sigma=0.2, disparity_sigma=0.3)
    result = adjust_rig(cameras, matches, disturbed(rig), None, SETTINGS)
    errors = np.array(
        [
            pose_distance(inverse(rig.truth[i]) @ rig.truth[j], inverse(result.poses[i]) @ result.poses[j])
            for i, j in matches
        ]
    )
    assert errors.mean(axis=0)[0] < 0.12
    assert errors.mean(axis=0)[1] < 5.0
    found = np.array([result.corrections[c].coefficients[0] for c in range(12)])
    assert np.abs(found - (rig.depth_scale - 1)).mean() < 0.006


def test_a_tenth_of_false_matches_moves_nothing_much() -> None:
    rig = SyntheticRig(cameras=3, points=1200)
    cameras, matches = neighbours_of(rig, pixel_sigma=0.2, disparity_sigma=0.3)
    clean = adjust_rig(cameras, matches, disturbed(rig), None, SETTINGS)
    spoiled = {pair: rows.copy() for pair, rows in matches.items()}
    for rows in spoiled.values():
        rows[::10, 1] = np.roll(rows[::10, 1], 1)
    robust = adjust_rig(cameras, spoiled, clean.poses, None, SETTINGS)
    for c in rig.truth:
        deg, mm = pose_distance(clean.poses[c], robust.poses[c])
        assert deg < 0.1
        assert mm < 4.0


def test_the_fixed_camera_stays_where_it_is() -> None:
    rig = SyntheticRig(cameras=3, points=600)
    cameras, matches = neighbours_of(rig, pixel_sigma=0.3, disparity_sigma=0.4)
    start = disturbed(rig)
    result = adjust_rig(cameras, matches, start, None, SETTINGS)
    assert result.poses[0].tobytes() == start[0].tobytes()
    assert not result.covariance_of(0).any()


def test_an_adjustment_is_the_same_in_every_run() -> None:
    rig = SyntheticRig(cameras=3, points=600)
    cameras, matches = neighbours_of(rig, pixel_sigma=0.3, disparity_sigma=0.4)
    first, second = (adjust_rig(cameras, matches, disturbed(rig), None, SETTINGS) for _ in range(2))
    assert all(first.poses[c].tobytes() == second.poses[c].tobytes() for c in rig.truth)


def test_a_camera_far_from_its_drawing_is_not_pulled_there() -> None:
    """One pose prior is wrong by 4 degrees and 3 cm; the matches win."""
    rig = SyntheticRig(cameras=3, points=1200)
    cameras, matches = neighbours_of(rig)
    knocked = rig.truth[1] @ se3_exp(np.array([np.deg2rad(4.0), 0, 0, 0, 0.03, 0]))
    wrong = replace(cameras[1], view=replace(cameras[1].view, T_rig_nominal=knocked))
    right = {
        c: replace(cameras[c], view=replace(cameras[c].view, T_rig_nominal=rig.truth[c])) for c in (0, 2)
    }
    result = adjust_rig({1: wrong, **right}, matches, rig.truth, rig.drawing, SETTINGS)
    deg, mm = pose_distance(inverse(rig.truth[0]) @ rig.truth[1], inverse(result.poses[0]) @ result.poses[1])
    assert deg < 0.05
    assert mm < 1.5
