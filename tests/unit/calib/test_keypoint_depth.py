"""Depth at keypoints: sub-pixel on surfaces, none at edges."""

import numpy as np
import pytest

from rig_calib.depth_model import depth_grid, disparity_of_depth
from rig_calib.keypoint_depth import keypoint_depth, keypoint_points, mean_disparity
from rig_calib.projection import pixel_rays, project
from rig_protocol.camera import CameraModel
from rig_protocol.poses import inverse, transform_points

MODEL = CameraModel()
GRID = depth_grid(MODEL, "depth")


def plane_disparity(normal: np.ndarray, distance_m: float) -> np.ndarray:
    """Disparity of the plane normal · X = distance, in the depth camera."""
    rays = np.concatenate([pixel_rays(GRID.intrinsics), np.ones((480, 640, 1))], axis=2)
    return disparity_of_depth(GRID.raw_model, distance_m / (rays @ normal))


@pytest.mark.parametrize("tilt", [0.0, 0.4, -0.7])
def test_a_keypoints_point_lies_on_the_slanted_surface_and_on_its_ray(tilt: float) -> None:
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    pixels = np.random.default_rng(0).uniform((150, 100), (450, 380), (40, 2))
    depth = keypoint_depth(MODEL.color, GRID, plane_disparity(normal, 1.4), pixels)
    points = keypoint_points(MODEL.color, GRID, pixels, depth)
    on_plane = transform_points(inverse(GRID.T_color_grid), points) @ normal
    np.testing.assert_allclose(on_plane, 1.4, atol=1e-4)
    np.testing.assert_allclose(project(MODEL.color, points), pixels, atol=1e-9)


def test_a_keypoint_on_a_step_of_depth_has_none() -> None:
    disparity = plane_disparity(np.array([0.0, 0.0, 1.0]), 2.0)
    disparity[:, :320] = plane_disparity(np.array([0.0, 0.0, 1.0]), 1.2)[:, :320]
    edge = project(MODEL.color, transform_points(GRID.T_color_grid, np.array([[0.0, 0.0, 1.2]])))
    depth = keypoint_depth(MODEL.color, GRID, disparity, edge + np.array([[0, 0], [150, 0], [-150, 0]]))
    assert depth.known.tolist() == [False, True, True]


def test_a_keypoint_in_a_hole_or_outside_has_none() -> None:
    disparity = plane_disparity(np.array([0.0, 0.0, 1.0]), 2.0)
    disparity[200:260, 280:360] = np.nan
    depth = keypoint_depth(
        MODEL.color, GRID, disparity, np.array([[320.0, 235.0], [-80.0, 5.0], [500.0, 400.0]])
    )
    assert depth.known.tolist() == [False, False, True]


def test_without_any_depth_no_keypoint_has_depth() -> None:
    depth = keypoint_depth(MODEL.color, GRID, np.full((480, 640), np.nan), np.array([[320.0, 240.0]]))
    assert not depth.known.any()


def test_a_wide_smooth_surface_gives_a_surer_disparity_than_a_narrow_one() -> None:
    wide = plane_disparity(np.array([0.0, 0.0, 1.0]), 2.0)
    narrow = np.full_like(wide, np.nan)
    narrow[236:244, 310:318] = wide[236:244, 310:318]
    pixel = project(MODEL.color, transform_points(GRID.T_color_grid, np.array([[-0.02, 0.0, 2.0]])))
    sigma_wide, sigma_narrow = (keypoint_depth(MODEL.color, GRID, d, pixel).sigma[0] for d in (wide, narrow))
    assert sigma_wide < sigma_narrow


def test_averaging_leaves_out_what_one_frame_saw_differently() -> None:
    frames = [np.full((2, 2), 800.0 + k) for k in (-0.5, 0.0, 0.5)]
    frames[1][0, 0] = 900.0
    frames[2][1, 1] = np.nan
    mean = mean_disparity(frames)
    assert mean[0, 0] == pytest.approx(800.0)
    assert mean[1, 1] == pytest.approx(799.75)


def test_a_pixel_that_most_frames_lack_has_no_mean() -> None:
    frames = [np.full((1, 1), value) for value in (np.nan, np.nan, 800.0)]
    assert np.isnan(mean_disparity(frames)).all()
