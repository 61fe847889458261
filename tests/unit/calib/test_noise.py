"""Noise measured from residuals, and what crowds of measurements are worth."""

import numpy as np

from rig_calib.noise import NoiseModel, observed_noise
from rig_calib.observation_model import Observations, isotropic_whitener

RNG = np.random.default_rng(0)
COUNT = 400
GRID = RNG.uniform((0, 0), (640, 480), (COUNT, 2))


def observations() -> Observations:
    return Observations(
        camera=np.zeros(COUNT, np.intp),
        point=np.arange(COUNT) // 2,
        pixels=GRID,
        pixel_whitener=isotropic_whitener(np.full(COUNT, 0.25)),
        disparity=np.full(COUNT, 800.0),
        slope=np.zeros((COUNT, 2)),
        grid_pixels=GRID,
        disparity_sigma=np.full(COUNT, 1.0),
    )


def test_a_lone_measurement_keeps_its_noise_and_a_crowd_shares_one() -> None:
    model = NoiseModel(disparity_distortion=0.0)
    lone = model.disparity_sigma(np.array([[100.0, 100.0]]), np.array([0.5]))
    crowd = model.disparity_sigma(np.full((9, 2), 100.0), np.full(9, 0.5))
    np.testing.assert_allclose(lone, 0.5)
    np.testing.assert_allclose((1 / crowd**2).sum(), 1 / 0.5**2)


def test_distant_measurements_do_not_share_noise() -> None:
    apart = NoiseModel().disparity_sigma(np.array([[50.0, 50.0], [600.0, 400.0]]), np.full(2, 0.5))
    alone = NoiseModel().disparity_sigma(np.array([[50.0, 50.0]]), np.full(1, 0.5))
    np.testing.assert_allclose(apart, alone[0])


def test_large_keypoints_are_placed_less_well() -> None:
    small, large = NoiseModel().keypoint_sigma(0.25, GRID[:2], np.array([1.0, 20.0]))
    assert small < 0.3
    assert large > 0.9


def test_residuals_as_assumed_leave_the_noise_of_a_rig_at_rest() -> None:
    residuals = 0.5 * RNG.standard_normal((COUNT, 3))
    found = observed_noise(observations(), residuals * (1, 1, 0.1), COUNT // 2)
    assert found.pixel_scale == 1.0
    assert found.disparity_distortion < 0.3


def test_larger_scatter_raises_the_keypoints_noise() -> None:
    found = observed_noise(observations(), 1.4 * RNG.standard_normal((COUNT, 3)), COUNT // 2)
    assert 1.5 < found.pixel_scale < 2.5


def test_residuals_that_neighbours_share_are_found_as_distortion() -> None:
    residuals = np.zeros((COUNT, 3))
    residuals[:, 2] = 0.4 * np.sin(GRID[:, 0] / 60.0)
    found = observed_noise(observations(), residuals, COUNT // 2)
    assert 0.3 < found.disparity_distortion < 0.8
    assert found.pixel_distortion == 0.0


def test_without_any_disparity_the_assumption_stands() -> None:
    seen = observations()
    empty = Observations(
        **{
            name: getattr(seen, name) if name != "disparity" else np.full(COUNT, np.nan)
            for name in Observations.__dataclass_fields__
        }
    )
    assert observed_noise(empty, np.zeros((COUNT, 3)), COUNT // 2) == NoiseModel()
