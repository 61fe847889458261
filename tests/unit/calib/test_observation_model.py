"""Residuals of observations against independent formulas, and their derivatives against differences."""

from dataclasses import replace

import numpy as np
import pytest

from rig_calib.depth_model import DepthCorrection, DepthGrid, disparity_of_depth
from rig_calib.landmark_rows import GravityObservations, LandmarkCounts, LandmarkRows, Rows
from rig_calib.observation_model import (
    CameraState,
    FactoryModels,
    Observations,
    PlaneObservations,
    adjusted_intrinsics,
    isotropic_whitener,
)
from rig_calib.projection import project, undistort_pixels
from rig_protocol.camera import Intrinsics, RawDepthModel
from rig_protocol.poses import inverse, se3_exp, so3_exp, transform_points
from support.synthetic_rig import COLOR, DEPTH

DISTORTED = Intrinsics(517.3, 516.5, 318.6, 255.3, dist=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
INFRARED = Intrinsics(594.2, 591.0, 339.3, 242.7, dist=(-0.1, 0.2, -0.0008, 0.005, -0.1))
T_COLOR_GRID = se3_exp(np.array([0.01, -0.02, 0.005, -0.025, 0.001, -0.004]))
COUNT, TERMS = 30, 10
STEP = 1e-6


def grid_of(depth: Intrinsics) -> DepthGrid:
    return DepthGrid(depth, T_COLOR_GRID, RawDepthModel())


def state(seed: int = 0) -> CameraState:
    """Every term well off the factory model."""
    rng = np.random.default_rng(seed)
    return CameraState(
        se3_exp(rng.normal(0, 0.2, 6)),
        rng.normal(0, 0.02, TERMS),
        np.array([0.004, 0.5, -0.8, 0.01]),
        rng.normal(0, 0.01, 6),
        np.array([-0.003, 0.7, 0.4]),
    )


def observations(seed: int = 0) -> tuple[np.ndarray, Observations]:
    """Points before the camera of `state`, and observations that need not fit."""
    rng = np.random.default_rng(seed)
    in_camera = rng.uniform((-0.6, -0.4, 1.0), (0.6, 0.4, 2.5), (COUNT, 3))
    disparity = rng.uniform(700, 900, COUNT)
    disparity[::5] = np.nan
    seen = Observations(
        camera=np.zeros(COUNT, np.intp),
        point=np.arange(COUNT),
        pixels=rng.uniform((0, 0), (640, 480), (COUNT, 2)),
        pixel_whitener=rng.normal(0, 2, (COUNT, 2, 2)),
        disparity=disparity,
        slope=rng.normal(0, 0.5, (COUNT, 2)),
        grid_pixels=rng.uniform((0, 0), (640, 480), (COUNT, 2)),
        disparity_sigma=rng.uniform(0.3, 0.6, COUNT),
    )
    return transform_points(state().T_rig_camera, in_camera), seen


def planes() -> tuple[np.ndarray, PlaneObservations]:
    """Three planes before the camera of `state`, and observations that need not fit."""
    rng = np.random.default_rng(3)
    seen = PlaneObservations(
        camera=np.zeros(COUNT, np.intp),
        plane=rng.integers(0, 3, COUNT),
        grid_pixels=rng.uniform((0, 0), (640, 480), (COUNT, 2)),
        disparity=rng.uniform(700, 900, COUNT),
        disparity_sigma=rng.uniform(0.3, 0.6, COUNT),
    )
    in_camera = np.array([[0.1, 0.05, 0.5], [-0.2, 0.1, 0.4], [0.0, 0.3, 0.6]])
    T = inverse(state().T_rig_camera)
    return in_camera @ T[:3, :3] / (1 - in_camera @ T[:3, 3])[:, None], seen


NO_POINTS = observations()[1].select(np.zeros(COUNT, dtype=bool))
NO_GRAVITY = GravityObservations(np.empty(0, np.intp), np.empty((0, 3)), np.empty(0))


def rows_of(problem: LandmarkRows, models: FactoryModels, at: CameraState, landmarks: np.ndarray) -> Rows:
    return problem.rows(models.with_states(at.T_rig_camera[None], at.beside_pose()[None]), landmarks)


def moved(at: CameraState, delta: np.ndarray) -> CameraState:
    return CameraState.from_columns(at.T_rig_camera @ se3_exp(delta[:6]), at.beside_pose() + delta[6:])


def assert_derivatives(problem: LandmarkRows, models: FactoryModels, landmarks: np.ndarray) -> None:
    """Central differences of the residuals, state by state and coordinate by coordinate."""
    rows = rows_of(problem, models, state(), landmarks)

    def slope(at: tuple[CameraState, np.ndarray], opposite: tuple[CameraState, np.ndarray]) -> np.ndarray:
        ahead, behind = (rows_of(problem, models, *where).residual for where in (at, opposite))
        return (ahead - behind) / (2 * STEP)

    for k, delta in enumerate(STEP * np.eye(models.state_size)):
        expected = slope((moved(state(), delta), landmarks), (moved(state(), -delta), landmarks))
        np.testing.assert_allclose(rows.by_state[:, k], expected, rtol=1e-5, atol=2e-3)
    for k, shift in enumerate(STEP * np.eye(3)):
        expected = slope((state(), landmarks + shift), (state(), landmarks - shift))
        np.testing.assert_allclose(rows.by_landmark[:, k], expected, rtol=1e-5, atol=2e-3)


def problem_of(
    models: FactoryModels,
    seen: Observations = NO_POINTS,
    seen_planes: PlaneObservations | None = None,
    gravity: GravityObservations = NO_GRAVITY,
) -> LandmarkRows:
    counts = LandmarkCounts(COUNT if len(seen) else 0, 3 if seen_planes else 0)
    return LandmarkRows(models, counts, seen, seen_planes or PlaneObservations.none(), gravity)


CAMERAS = [(COLOR, DEPTH), (DISTORTED, INFRARED)]


@pytest.mark.parametrize(("color", "depth"), CAMERAS)
def test_derivatives_of_pixels_and_disparities_are_right(color: Intrinsics, depth: Intrinsics) -> None:
    points, seen = observations()
    models = FactoryModels.of([color], [grid_of(depth)], TERMS)
    assert_derivatives(problem_of(models, seen), models, points)


@pytest.mark.parametrize(("color", "depth"), CAMERAS)
def test_derivatives_of_planes_are_right(color: Intrinsics, depth: Intrinsics) -> None:
    landmarks, seen = planes()
    models = FactoryModels.of([color], [grid_of(depth)], TERMS)
    assert_derivatives(problem_of(models, seen_planes=seen), models, landmarks)


def test_derivatives_of_gravity_are_right() -> None:
    models = FactoryModels.of([COLOR], [grid_of(DEPTH)], TERMS)
    gravity = GravityObservations(np.zeros(1, np.intp), np.array([[0.1, 0.9, 0.3]]), np.array([0.01]))
    assert_derivatives(problem_of(models, gravity=gravity), models, np.array([[0.05, 0.1, -1.0]]))


def adjusted_grid(at: CameraState, depth: Intrinsics) -> tuple[np.ndarray, Intrinsics]:
    """T_color_grid and the grid's intrinsics as the state says they are."""
    R, t = T_COLOR_GRID[:3, :3], T_COLOR_GRID[:3, 3]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R @ so3_exp(at.grid_pose[:3]), t + R @ at.grid_pose[3:]
    return T, adjusted_intrinsics(depth, np.append(at.grid_intrinsics, 0.0))


def measured_disparity(at: CameraState, depth: Intrinsics, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
    """What a biased camera measures of the depth z at the grid's pixels."""
    x, y = ((pixels - (depth.cx, depth.cy)) / (depth.fx, depth.fy)).T
    factor = DepthCorrection(tuple(at.bias)).factor(x, y)
    return disparity_of_depth(RawDepthModel(), z / factor)


@pytest.mark.parametrize(("color", "depth"), CAMERAS)
def test_a_point_is_predicted_where_the_adjusted_models_see_it(color: Intrinsics, depth: Intrinsics) -> None:
    at, (points, seen) = state(), observations()
    T_color_grid, grid = adjusted_grid(at, depth)
    in_camera = transform_points(inverse(at.T_rig_camera), points)
    in_grid = transform_points(inverse(T_color_grid), in_camera)
    grid_pixels = project(grid, in_grid)
    true = replace(
        seen,
        pixels=project(adjusted_intrinsics(color, at.intrinsics), in_camera),
        grid_pixels=grid_pixels,
        disparity=measured_disparity(at, depth, grid_pixels, in_grid[:, 2]),
    )
    models = FactoryModels.of([color], [grid_of(depth)], TERMS)
    np.testing.assert_allclose(rows_of(problem_of(models, true), models, at, points).residual, 0.0, atol=1e-6)


@pytest.mark.parametrize(("color", "depth"), CAMERAS)
def test_a_plane_is_predicted_as_deep_as_the_adjusted_models_see_it(
    color: Intrinsics, depth: Intrinsics
) -> None:
    at, (landmarks, seen) = state(), planes()
    T_color_grid, grid = adjusted_grid(at, depth)
    T_rig_grid = at.T_rig_camera @ T_color_grid
    rays = np.column_stack([undistort_pixels(grid, seen.grid_pixels), np.ones(COUNT)])
    # π · (R r z + t) = 1
    plane = landmarks[seen.plane]
    z = (1 - plane @ T_rig_grid[:3, 3]) / np.einsum("mi,mi->m", plane, rays @ T_rig_grid[:3, :3].T)
    true = replace(seen, disparity=measured_disparity(at, depth, seen.grid_pixels, z))
    models = FactoryModels.of([color], [grid_of(depth)], TERMS)
    residual = rows_of(problem_of(models, seen_planes=true), models, at, landmarks).residual
    np.testing.assert_allclose(
        residual, 0.0, atol=2e-3
    )  # the ray follows the grid's intrinsics to first order


def test_a_pixel_or_disparity_that_was_not_measured_says_nothing() -> None:
    points, seen = observations()
    seen = replace(seen, pixel_whitener=seen.pixel_whitener * (np.arange(COUNT) % 2)[:, None, None])
    models = FactoryModels.of([COLOR], [grid_of(DEPTH)], TERMS)
    rows = rows_of(problem_of(models, seen), models, state(), points)
    for numbers in (rows.residual[:, None], rows.by_state, rows.by_landmark):
        by_observation = numbers.reshape(COUNT, 3, -1)
        assert not by_observation[::2, :2].any()
        assert not by_observation[np.isnan(seen.disparity), 2].any()
        assert by_observation[1::2, :2].any()


def test_a_point_behind_its_camera_is_never_an_improvement() -> None:
    points, seen = observations()
    models = FactoryModels.of([COLOR], [grid_of(DEPTH)], TERMS)
    behind = 2 * state().T_rig_camera[:3, 3] - points
    rows = rows_of(problem_of(models, seen), models, state(), behind)
    assert (rows.residual.reshape(COUNT, 3)[:, :2] > 1e5).all()
    assert not rows.by_state.any()


def test_residuals_come_back_in_the_order_of_the_observations() -> None:
    points, seen = observations()
    models = FactoryModels.of([COLOR], [grid_of(DEPTH)], TERMS)
    order = np.random.default_rng(1).permutation(COUNT)
    results = []
    for given in (seen, seen.select(order)):
        problem = problem_of(models, given)
        results.append(problem.split_residuals(rows_of(problem, models, state(), points).residual)[0])
    np.testing.assert_array_equal(results[1], results[0][order])


def test_whitened_residuals_become_pixels_again() -> None:
    error = np.array([[0.3, -0.2], [0.1, 0.4], [1.0, 2.0]])
    across = np.outer([0.6, 0.8], [0.6, 0.8])
    W = np.stack([isotropic_whitener(np.array([0.5]))[0], across / 0.5, np.zeros((2, 2))])
    seen = replace(observations()[1].select(np.arange(3)), pixel_whitener=W)
    expected = np.stack([error[0], across @ error[1], [0.0, 0.0]])
    np.testing.assert_allclose(seen.pixel_error(np.einsum("mij,mj->mi", W, error)), expected)
    np.testing.assert_allclose(seen.pixel_sigma, [0.5, 0.5, np.inf])
