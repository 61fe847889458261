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


def information_of(model: NoiseModel, information: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    whitener = model.pixel_whitener(information, pixels)
    return np.einsum("nki,nkj->nij", whitener, whitener)


def test_a_lone_pixel_keeps_what_is_known_of_it_in_every_direction() -> None:
    alone = np.array([[[16.0, 6.0], [6.0, 9.0]]])
    whitened = information_of(NoiseModel(pixel_distortion=0.0), alone, GRID[:1])
    np.testing.assert_allclose(whitened, alone)
    twice_the_noise = NoiseModel(pixel_scale=2.0, pixel_distortion=0.0)
    np.testing.assert_allclose(information_of(twice_the_noise, alone, GRID[:1]), alone / 4)


def test_a_pixel_on_an_edge_says_nothing_along_it() -> None:
    along = np.array([0.6, 0.8])
    across = np.array([0.8, -0.6])
    edge = 400.0 * np.outer(across, across)[None]
    known = information_of(NoiseModel(), edge, GRID[:1])[0]
    np.testing.assert_allclose(known @ along, 0.0, atol=1e-6)
    assert 0.5 * 400.0 < across @ known @ across < 400.0
    assert not information_of(NoiseModel(), np.zeros((1, 2, 2)), GRID[:1]).any()


def test_a_crowd_of_pixels_knows_no_more_than_its_shared_distortion_allows() -> None:
    model = NoiseModel(pixel_distortion=0.1)
    exact = np.broadcast_to(np.eye(2) * 1e8, (9, 2, 2))
    crowd = information_of(model, exact, np.full((9, 2), 100.0))
    np.testing.assert_allclose(crowd.sum(axis=0), np.eye(2) / 0.1**2, rtol=1e-3)


def test_residuals_as_assumed_leave_the_noise_of_a_rig_at_rest() -> None:
    residuals = 0.5 * RNG.standard_normal((COUNT, 3))
    found = observed_noise(observations(), residuals * (1, 1, 0.1))
    assert found.pixel_scale == 1.0
    assert found.disparity_distortion < 0.3


def test_larger_scatter_raises_the_keypoints_noise() -> None:
    found = observed_noise(observations(), 1.4 * RNG.standard_normal((COUNT, 3)))
    assert 1.5 < found.pixel_scale < 2.5


def test_residuals_that_neighbours_share_are_found_as_distortion() -> None:
    residuals = np.zeros((COUNT, 3))
    residuals[:, 2] = 0.4 * np.sin(GRID[:, 0] / 60.0)
    found = observed_noise(observations(), residuals)
    assert 0.3 < found.disparity_distortion < 0.8
    assert found.pixel_distortion == NoiseModel().pixel_distortion


def test_without_any_disparity_the_assumption_stands() -> None:
    seen = observations()
    empty = Observations(
        **{
            name: getattr(seen, name) if name != "disparity" else np.full(COUNT, np.nan)
            for name in Observations.__dataclass_fields__
        }
    )
    assert observed_noise(empty, np.zeros((COUNT, 3))) == NoiseModel()
