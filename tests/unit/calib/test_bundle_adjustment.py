"""The joint adjustment: exact recovery, bias, false matches, planes, gravity, states that are held."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from rig_calib import bundle_adjustment
from rig_calib.bundle_adjustment import AdjustedCamera, adjust
from rig_calib.depth_model import depth_grid, disparity_of_depth
from rig_calib.noise import NoiseModel
from rig_calib.observation_model import CameraState, Observations, PlaneObservations
from rig_calib.projection import from_pixels
from rig_calib.rig_adjustment import adjust_rig
from rig_calib.settings import CalibrationSettings
from rig_calib.tracks import build_scene, build_tracks
from rig_protocol.poses import Pose, inverse, se3_exp
from support.synthetic_rig import COLOR, MODEL, SyntheticRig, pose_distance, true_matches

GRID = depth_grid(MODEL, "depth")
SETTINGS = CalibrationSettings()


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


def cameras_at(
    poses: Sequence[Pose], fixed: Sequence[int], bias_terms: int = 1, **fields: object
) -> list[AdjustedCamera]:
    """Cameras of factory models with states beside the pose held, but for a depth scale."""
    held = AdjustedCamera(
        COLOR, GRID, CameraState(np.eye(4), np.zeros(bias_terms)), np.full(bias_terms, 0.01), np.zeros(4)
    )
    return [
        replace(held, start=CameraState(T, np.zeros(bias_terms)), fixed_pose=c in fixed, **fields)
        for c, T in enumerate(poses)
    ]


def scene_of(rig: SyntheticRig, poses: dict[int, Pose], **noise: float) -> tuple[np.ndarray, Observations]:
    cameras, matches = neighbours_of(rig, **noise)
    scene = build_scene(cameras, build_tracks(cameras, matches), poses, NoiseModel())
    return scene.points, scene.observations


def test_one_camera_is_found_between_others_that_are_fixed() -> None:
    """Recalibration: the fixed cameras stay to the bit, the free one is found with its known depth scale."""
    rig = SyntheticRig(cameras=3, points=1200, bias=0.02)
    start = [
        rig.truth[0],
        rig.truth[1] @ se3_exp(np.array([0.05, -0.03, 0.02, 0.03, 0.0, -0.02])),
        rig.truth[2],
    ]
    known = [CameraState(np.eye(4), np.array([scale - 1.0])) for scale in rig.depth_scale]
    cameras = [
        replace(
            camera, start=replace(camera.start, bias=state.bias), expected=state, bias_sigma=np.array([1e-4])
        )
        for camera, state in zip(cameras_at(start, fixed=[0, 2]), known, strict=True)
    ]
    result = adjust(cameras, *scene_of(rig, rig.truth))
    assert all(result.states[c].T_rig_camera.tobytes() == rig.truth[c].tobytes() for c in (0, 2))
    deg, mm = pose_distance(rig.truth[1], result.states[1].T_rig_camera)
    assert deg < 0.01
    assert mm < 0.3
    assert abs(result.states[1].bias[0] - known[1].bias[0]) < 1e-3


def test_a_state_without_tolerance_is_held_and_leaves_no_information() -> None:
    rig = SyntheticRig(cameras=2, points=600)
    start = [rig.truth[0], rig.truth[1] @ se3_exp(np.full(6, 0.01))]
    result = adjust(cameras_at(start, fixed=[0]), *scene_of(rig, rig.truth))
    size = len(result.normal) // 2
    for c, state in enumerate(result.states):
        assert not np.concatenate([state.intrinsics, state.grid_pose, state.grid_intrinsics]).any()
        assert state.bias.any()
        assert not result.normal[c * size + 7 : (c + 1) * size].any()
    assert result.normal[size : size + 7].any(axis=1).all()


def test_a_wrong_focal_length_is_found_and_does_not_spoil_the_poses() -> None:
    rig = SyntheticRig(cameras=3, points=2500)
    wrong_color = replace(COLOR, fx=COLOR.fx / 1.01, fy=COLOR.fy / 1.01)
    cameras = [
        replace(camera, color=wrong_color, intrinsics_sigma=np.array([0.02, 5.0, 5.0, 0.01]))
        for camera in cameras_at([rig.truth[c] for c in range(3)], fixed=[0])
    ]
    result = adjust(cameras, *scene_of(rig, rig.truth))
    for c, state in enumerate(result.states):
        assert abs(state.intrinsics[0] - np.log(1.01)) < 1e-3
        deg, mm = pose_distance(rig.truth[c], state.T_rig_camera)
        assert deg < 0.05
        assert mm < 2.0


WALLS = np.array([[0.5, -0.2, 0.02], [0.35, 0.4, -0.03], [0.02, -0.03, -1.6]])
"""Two walls that meet in the overlap of two neighbours, and the floor; π · X = 1 in the rig frame."""


def wall_observations(T_rig_camera: Sequence[Pose], sigma: float) -> PlaneObservations:
    """Disparities of the nearest wall on a coarse grid of pixels."""
    rng = np.random.default_rng(0)
    camera, plane, pixels, disparity = [], [], [], []
    v, u = np.mgrid[10:480:40, 10:640:40]
    grid_pixels = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    rays = np.column_stack([from_pixels(GRID.intrinsics, grid_pixels), np.ones(len(grid_pixels))])
    for c, T in enumerate(T_rig_camera):
        T_rig_grid = T @ GRID.T_color_grid
        inverse_depth = (rays @ T_rig_grid[:3, :3].T @ WALLS.T) / (1 - WALLS @ T_rig_grid[:3, 3])
        nearest = inverse_depth.argmax(axis=1)
        z = 1 / inverse_depth.max(axis=1)
        inside = (z > 0.4) & (z < 6.0)
        camera.append(np.full(inside.sum(), c))
        plane.append(nearest[inside])
        pixels.append(grid_pixels[inside])
        disparity.append(disparity_of_depth(GRID.raw_model, z[inside]))
    exact = np.concatenate(disparity)
    noisy = exact + sigma * rng.standard_normal(len(exact))
    sigmas = np.full(len(exact), 0.5)
    return PlaneObservations(
        np.concatenate(camera), np.concatenate(plane), np.concatenate(pixels), noisy, sigmas
    )


def no_points() -> tuple[np.ndarray, Observations]:
    rig = SyntheticRig(cameras=2, points=300)
    return np.empty((0, 3)), scene_of(rig, rig.truth)[1].select(np.zeros(0, np.intp))


def test_three_shared_planes_alone_place_a_camera() -> None:
    rig = SyntheticRig(cameras=2)
    truth = [rig.truth[0], rig.truth[1]]
    start = truth[1] @ se3_exp(np.array([0.02, -0.03, 0.01, 0.02, 0.01, -0.03]))
    cameras = cameras_at([truth[0], start], fixed=[0], bias_terms=0)
    result = adjust(cameras, *no_points(), WALLS * 1.03, wall_observations(truth, sigma=0.0))
    deg, mm = pose_distance(truth[1], result.states[1].T_rig_camera)
    assert deg < 1e-3
    assert mm < 0.02
    np.testing.assert_allclose(result.planes, WALLS, atol=1e-5)


def test_planes_and_points_share_one_adjustment() -> None:
    """Walls added to a few points make the camera better known, by as much as the normal matrix says."""
    rig = SyntheticRig(cameras=2, points=300)
    truth = [rig.truth[0], rig.truth[1]]
    seen = wall_observations(truth, sigma=0.5)
    problem = scene_of(rig, rig.truth, pixel_sigma=0.3, disparity_sigma=0.4)
    cameras = cameras_at(truth, fixed=[0])
    alone, together = adjust(cameras, *problem), adjust(cameras, *problem, WALLS, seen)
    size = len(alone.normal) // 2
    more = together.normal[size : size + 6, size : size + 6] - alone.normal[size : size + 6, size : size + 6]
    assert np.linalg.eigvalsh(more)[0] > 0
    assert len(together.plane_residuals) == len(seen)
    assert np.abs(together.plane_residuals).mean() < 1.0


def test_gravity_ties_the_tilt_of_cameras_that_share_no_view() -> None:
    """Down is a landmark of its own: nobody need know how the rig stands."""
    rig = SyntheticRig(cameras=2)
    down = np.array([0.1, -0.05, -0.99])
    down /= np.linalg.norm(down)
    truth = [rig.truth[0], rig.truth[1]]
    tilted = truth[1] @ se3_exp(np.array([0.03, 0.01, -0.02, 0, 0, 0]))
    loose = {"pose_sigma": np.repeat([np.deg2rad(2.0), 0.01], 3), "gravity_sigma": np.deg2rad(0.5)}
    cameras = [
        replace(camera, gravity=T[:3, :3].T @ down, T_prior=start, **loose)
        for camera, T, start in zip(
            cameras_at([truth[0], tilted], fixed=[0]), truth, (truth[0], tilted), strict=True
        )
    ]
    result = adjust(cameras, *no_points())
    felt, before = (T[:3, :3].T @ down for T in (result.states[1].T_rig_camera, tilted))
    wanted = truth[1][:3, :3].T @ down
    assert np.linalg.norm(felt - wanted) < 0.2 * np.linalg.norm(before - wanted)


def test_many_cameras_are_solved_as_a_sparse_system_with_the_same_result(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = SyntheticRig(cameras=3, points=600)
    problem = scene_of(rig, rig.truth, pixel_sigma=0.3, disparity_sigma=0.4)
    cameras = cameras_at([rig.truth[c] @ se3_exp(np.full(6, 0.005 * c)) for c in range(3)], fixed=[0])
    dense = adjust(cameras, *problem)
    monkeypatch.setattr(bundle_adjustment, "_MANY_STATES", 0)
    sparse = adjust(cameras, *problem)
    for one, other in zip(dense.states, sparse.states, strict=True):
        np.testing.assert_allclose(one.T_rig_camera, other.T_rig_camera, atol=1e-9)


def test_points_behind_a_camera_at_the_start_do_not_stop_the_adjustment() -> None:
    rig = SyntheticRig(cameras=2, points=600)
    points, seen = scene_of(rig, rig.truth)
    points[:2] = -points[:2]
    result = adjust(
        cameras_at([rig.truth[0], rig.truth[1] @ se3_exp(np.full(6, 0.01))], fixed=[0]), points, seen
    )
    deg, mm = pose_distance(rig.truth[1], result.states[1].T_rig_camera)
    assert deg < 1e-2
    assert mm < 0.5
