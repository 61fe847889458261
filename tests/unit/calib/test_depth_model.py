"""Depth images of all three kinds become the same points, with honest noise."""

from dataclasses import replace

import numpy as np
import pytest

from rig_calib.depth_model import (
    DepthCorrection,
    depth_of_disparity,
    depth_points,
    disparity_image,
    disparity_of_depth,
)
from rig_calib.view import CameraView
from rig_protocol.camera import CameraModel
from rig_protocol.errors import DataError
from rig_protocol.poses import transform_points

MODEL = CameraModel()
COLOR = np.zeros((480, 640), dtype=np.uint8)


def raw_view(raw: np.ndarray) -> CameraView:
    return CameraView(0, "cam00", MODEL, (COLOR,), raw=(raw.astype(np.uint16),))


def wall(depth_m: float) -> np.ndarray:
    return np.full((480, 640), round(float(disparity_of_depth(MODEL.raw_model, np.array(depth_m)))))


def test_raw_and_millimetres_of_one_wall_give_the_same_points() -> None:
    raw = depth_points(raw_view(wall(2.0)), 0)
    exact_m = float(depth_of_disparity(MODEL.raw_model, np.array(float(wall(2.0)[0, 0]))))
    mm = np.full((480, 640), round(exact_m * 1e3), dtype=np.uint16)
    rounded = depth_points(replace(raw_view(wall(2.0)), raw=(), depth_mm=(mm,)), 0)
    np.testing.assert_allclose(rounded.points_m, raw.points_m, atol=1e-3)


def test_points_of_the_depth_camera_are_moved_into_the_colour_camera() -> None:
    points = depth_points(raw_view(wall(2.0)), 0)
    assert MODEL.depth is not None
    assert MODEL.T_color_depth is not None
    z = float(depth_of_disparity(MODEL.raw_model, np.array(float(wall(2.0)[0, 0]))))
    expected = transform_points(
        MODEL.T_color_depth, np.array([(100 - MODEL.depth.cx) / MODEL.depth.fx * z, 0.0, z])
    )
    row = np.flatnonzero((points.pixels == (100, 239)).all(axis=1))[0]
    assert points.points_m[row, 0] == pytest.approx(expected[0])
    assert points.points_m[row, 2] == pytest.approx(z)


def test_registered_depth_lies_on_the_colour_pixels_it_came_with() -> None:
    mm = np.full((480, 640), 1500, dtype=np.uint16)
    points = depth_points(CameraView(0, "cam00", MODEL, (COLOR,), depth_mm=(mm,), depth_frame="color"), 0)
    np.testing.assert_allclose(points.color_pixels, points.pixels, atol=1e-9)


def test_noise_is_half_a_raw_step_at_every_distance() -> None:
    for depth_m in (0.8, 2.0, 4.0):
        points = depth_points(raw_view(wall(depth_m)), 0)
        z = points.points_m[0, 2]
        assert points.sigma_z_m[0] == pytest.approx(0.5 * z**2 / MODEL.raw_model.numerator_m, rel=1e-6)


def test_holes_and_depth_out_of_range_are_left_out() -> None:
    raw = wall(2.0)
    raw[:100] = 2047
    raw[100:200] = wall(9.0)[0, 0]
    raw[200:300] = wall(0.3)[0, 0]
    assert depth_points(raw_view(raw), 0).pixels[:, 1].min() == 300


def test_only_steps_and_holes_are_edges_not_slanted_planes() -> None:
    raw = np.tile(700.0 + np.round(0.5 * np.arange(640)), (480, 1))
    raw[:, 400:] += 40
    raw[200, 100] = 2047
    points = depth_points(raw_view(raw), 0)
    marked = {tuple(pixel) for pixel in points.pixels[points.near_edge].tolist()}
    assert {(399, 50), (400, 50), (99, 200), (101, 200), (100, 199)} <= marked
    assert (300, 300) not in marked
    assert points.near_edge.mean() < 0.02


def test_a_correction_scales_depth_and_not_direction() -> None:
    plain, scaled = (depth_points(raw_view(wall(2.0)), 0, c) for c in (None, DepthCorrection((0.01,))))
    assert scaled.points_m[:, 2] == pytest.approx(plain.points_m[:, 2] * 1.01)


def test_an_image_of_another_size_than_its_camera_is_refused() -> None:
    with pytest.raises(DataError, match="320×240"):
        disparity_image(raw_view(np.zeros((240, 320))), 0)
