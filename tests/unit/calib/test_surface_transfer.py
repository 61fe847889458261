"""A pixel of one camera in another, through the plane that depth measured: against points on true planes."""

import numpy as np
import pytest

from rig_calib.depth_model import DepthCorrection, depth_grid, disparity_of_depth
from rig_calib.keypoint_depth import KeypointDepth
from rig_calib.projection import from_pixels, project
from rig_calib.surface_transfer import surface_planes, transfer, transfer_affine
from rig_protocol.camera import CameraModel, Intrinsics
from rig_protocol.poses import inverse, se3_exp, transform_points

SOURCE = Intrinsics(525.0, 523.0, 318.0, 241.0, dist=(0.05, -0.02, 0.0, 0.0, 0.0))
TARGET = Intrinsics(530.0, 531.0, 322.0, 238.0, dist=(-0.04, 0.01, 0.0, 0.0, 0.0))
DEPTH = Intrinsics(580.0, 582.0, 315.0, 244.0)
T_COLOR_DEPTH = se3_exp(np.array([0.004, -0.006, 0.003, -0.025, 0.001, 0.002]))
GRID = depth_grid(CameraModel(color=SOURCE, depth=DEPTH, T_color_depth=T_COLOR_DEPTH), "depth")
T_TARGET_SOURCE = se3_exp(np.array([0.08, -0.12, 0.05, 0.12, -0.07, 0.03]))
PLANE = np.array([0.15, -0.2, 0.55])  # π · X = 1 in the source, a slanted wall at about 1.8 m
RNG = np.random.default_rng(0)


def wall_points(count: int = 60) -> np.ndarray:
    """Points (N,3) of the plane in front of the source."""
    rays = np.column_stack([RNG.uniform(-0.35, 0.35, (count, 2)), np.ones(count)])
    return rays / (rays @ PLANE)[:, None]


def planes_of(count: int) -> np.ndarray:
    return np.tile(PLANE, (count, 1))


def measured_on_wall(points: np.ndarray, factor: np.ndarray | float = 1.0) -> KeypointDepth:
    """What a depth camera, whose depth wants to be multiplied by `factor`, reads at points of the plane."""
    in_grid = transform_points(inverse(GRID.T_color_grid), points)
    at = project(DEPTH, in_grid)

    def disparity(pixels: np.ndarray) -> np.ndarray:
        rays = np.column_stack([from_pixels(DEPTH, pixels), np.ones(len(pixels))])
        origin, turned = GRID.T_color_grid[:3, 3], rays @ GRID.T_color_grid[:3, :3].T
        depth_m = (1.0 - PLANE @ origin) / (turned @ PLANE)
        return disparity_of_depth(GRID.raw_model, depth_m / factor)

    slope = np.column_stack([(disparity(at + step) - disparity(at - step)) / 2 for step in np.eye(2)])
    return KeypointDepth(disparity(at), slope, at, np.full(len(points), 0.3))


def test_a_pixel_lands_where_its_true_point_is_seen() -> None:
    points = wall_points()
    expected = project(TARGET, transform_points(T_TARGET_SOURCE, points))
    found = transfer(SOURCE, TARGET, T_TARGET_SOURCE, planes_of(len(points)), project(SOURCE, points))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_planes_are_those_of_the_wall_that_depth_measured() -> None:
    points = wall_points()
    np.testing.assert_allclose(
        surface_planes(GRID, measured_on_wall(points), None), planes_of(len(points)), atol=1e-6
    )


def test_a_depth_correction_moves_the_plane_as_it_multiplies_the_depth() -> None:
    points = wall_points()
    correction = DepthCorrection((0.03,))
    false, right = (surface_planes(GRID, measured_on_wall(points, 1.03), c) for c in (None, correction))
    np.testing.assert_allclose(right, planes_of(len(points)), atol=1e-6)
    assert np.abs(false - PLANE).max() > 0.01


def test_keypoints_without_depth_have_no_plane_and_land_nowhere() -> None:
    depth = measured_on_wall(wall_points(3))
    depth.disparity[1] = np.nan
    planes = surface_planes(GRID, depth, None)
    assert np.isnan(planes).all(axis=1).tolist() == [False, True, False]
    found = transfer(SOURCE, TARGET, T_TARGET_SOURCE, planes, np.full((3, 2), 200.0))
    assert np.isnan(found).all(axis=1).tolist() == [False, True, False]


def test_the_affine_map_predicts_where_neighbouring_pixels_land() -> None:
    points = wall_points()
    pixels, planes = project(SOURCE, points), planes_of(len(points))
    affine = transfer_affine(SOURCE, TARGET, T_TARGET_SOURCE, planes, pixels)
    here = transfer(SOURCE, TARGET, T_TARGET_SOURCE, planes, pixels)
    for step in (np.array([0.01, 0.0]), np.array([0.0, 0.01]), np.array([-0.01, 0.02])):
        moved = transfer(SOURCE, TARGET, T_TARGET_SOURCE, planes, pixels + step) - here
        np.testing.assert_allclose(affine @ step, moved, atol=2e-5)
    # Off the diagonal, too, or a transposed map would pass.
    assert np.abs(affine[:, 0, 1] - affine[:, 1, 0]).min() > 0.05


@pytest.mark.parametrize(
    ("T_target_source", "plane"),
    [
        (se3_exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0])), PLANE),
        (np.eye(4), -PLANE),
        (np.eye(4), np.array([0.0, 0.0, 1 / 0.01])),
    ],
    ids=["behind the target", "behind the source", "inside the lens"],
)
def test_what_no_camera_can_see_is_nowhere(T_target_source: np.ndarray, plane: np.ndarray) -> None:
    pixels = np.array([[320.0, 240.0], [100.0, 400.0]])
    planes = np.tile(plane, (2, 1))
    assert np.isnan(transfer(SOURCE, TARGET, T_target_source, planes, pixels)).all()
    assert np.isnan(transfer_affine(SOURCE, TARGET, T_target_source, planes, pixels)).all()
