"""Range images: depth corrected, colours matched, frames averaged, holes kept."""

from dataclasses import replace

import numpy as np
import pytest

from rig_calib.depth_model import DISPARITY_SIGMA, DepthCorrection, depth_grid
from rig_calib.fusion.cleaning import bridge_gaps
from rig_calib.fusion.surface import clean_disparity
from rig_calib.rig_calibration import CalibratedCamera
from rig_calib.tsdf.range_image import range_image, range_images
from support.box_room import BoxRoom, calibration_of, ring_poses, with_noise

POSES = ring_poses(2)
VIEW = BoxRoom().view(0, POSES[0])
CAMERA = CalibratedCamera(0, "cam00", POSES[0])


def test_depth_is_measured_where_the_room_is_smooth_and_nowhere_else() -> None:
    image = range_image(VIEW, CAMERA)
    known = image.inverse_depth > 0
    assert known.mean() > 0.8
    off_m = 1 / image.inverse_depth[known] - VIEW.depth_mm[0][known] * 1e-3
    assert np.abs(off_m).max() < 5e-3
    assert (image.incidence[~known] == 0).all()
    assert not image.colored[~known].any()
    np.testing.assert_array_equal(image.T_rig_grid, POSES[0])


def test_the_depth_correction_is_applied() -> None:
    plain = range_image(VIEW, CAMERA)
    corrected = range_image(VIEW, replace(CAMERA, depth_correction=DepthCorrection((0.02,))))
    known = plain.inverse_depth > 0
    np.testing.assert_allclose(plain.inverse_depth[known] / corrected.inverse_depth[known], 1.02, rtol=1e-5)


def test_the_gain_is_applied_to_each_channel() -> None:
    plain, bright = range_image(VIEW, CAMERA), range_image(VIEW, CAMERA, np.array([1.0, 1.1, 0.5]))
    ratio = bright.colors[plain.colored].mean(axis=0) / plain.colors[plain.colored].mean(axis=0)
    np.testing.assert_allclose(ratio, [1.0, 1.1, 0.5], rtol=0.01)


def test_the_noise_is_the_units_and_frames_are_averaged() -> None:
    noisy = range_image(with_noise(VIEW, frames=8), CAMERA)
    assert noisy.frames == 8
    assert noisy.sigma_1m == pytest.approx(DISPARITY_SIGMA / VIEW.model.raw_model.numerator_m)
    known = noisy.inverse_depth > 0
    depth_m = VIEW.depth_mm[0][known] * 1e-3
    off_sigmas = (1 / noisy.inverse_depth[known] - depth_m) / (noisy.sigma_1m * depth_m**2)
    one_frame = np.hypot(0.5, np.sqrt(1 / 12)) / DISPARITY_SIGMA  # noise and rounding, in raw steps
    assert off_sigmas.std() < one_frame / np.sqrt(8)


def test_cameras_that_give_nothing_are_named_with_the_reason() -> None:
    views = [VIEW, replace(BoxRoom().view(1, POSES[1]), depth_mm=()), BoxRoom().view(5, POSES[0])]
    images, skipped = range_images(views, calibration_of(POSES), {})
    assert len(images) == 1
    assert skipped == (
        "cam01: left out, it delivered no colour with depth",
        "cam05: left out, the calibration could not place it",
    )


def test_single_pixels_without_depth_are_bridged_along_planes_and_holes_stay() -> None:
    rows, columns = np.indices((30, 40)).astype(np.float64)
    plane = 500 + 4.0 * columns - 2.5 * rows
    torn = plane.copy()
    torn[10, 10] = torn[20, 31] = np.nan
    torn[14:17, 20:23] = np.nan
    bridged = bridge_gaps(torn)
    hole = np.zeros(plane.shape, np.bool_)
    hole[14:17, 20:23] = True
    np.testing.assert_allclose(bridged[~hole], plane[~hole])
    assert np.isnan(bridged[hole]).sum() == 9


def test_nothing_is_bridged_between_two_surfaces_that_is_not_taken_out_again() -> None:
    step = np.where(np.arange(60) < 30, 700.0, 600.0) * np.ones((60, 1))
    step[:, 30] = np.nan  # what the near surface hides from the projector
    bridged = bridge_gaps(step)
    grid = depth_grid(VIEW.model, "color")
    solid = clean_disparity(grid, bridged)[2]
    assert not (np.abs(bridged[solid] - 650) < 40).any()
    assert solid[:, :25].any()
    assert solid[:, 35:].any()
