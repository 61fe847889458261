"""Rules of the colour sensor: mosaic, noise, exposure."""

import cv2
import numpy as np
import pytest

from rig_agent.simulator.color_sensor import BayerSensor, mosaic


def grey_scene(level: int) -> np.ndarray:
    return np.full((960, 1280, 3), level, np.uint8)


def test_mosaic_is_grbg() -> None:
    color = np.array([30, 120, 220], np.float32)  # BGR
    bayer = mosaic(np.broadcast_to(color, (8, 8, 3))).astype(np.uint8)
    assert bayer[:2, :2].tolist() == [[120, 220], [30, 120]]
    assert np.array_equal(cv2.cvtColor(bayer, cv2.COLOR_BayerGRBG2BGR)[4, 4], [30, 120, 220])


def test_exposure_scales_the_automatic_level() -> None:
    means = [
        BayerSensor(np.random.default_rng(0), grey_scene(90), 2, exposure)
        .frame(np.random.default_rng(1))[200:280, 280:360]
        .mean()
        for exposure in (0.8, 1.0, 1.2)
    ]
    assert means[1] == pytest.approx(105, rel=0.03)
    assert means[0] / means[1] == pytest.approx(0.8, rel=0.03)
    assert means[2] / means[1] == pytest.approx(1.2, rel=0.03)


def test_corners_are_darker_than_the_middle() -> None:
    bayer = BayerSensor(np.random.default_rng(0), grey_scene(90), 2, 1.0).frame(np.random.default_rng(1))
    assert 0.8 < bayer[:20, :20].mean() / bayer[230:250, 310:330].mean() < 0.9


def test_noise_grows_with_the_light_and_is_fresh_in_every_frame() -> None:
    def difference(exposure: float) -> np.ndarray:
        sensor = BayerSensor(np.random.default_rng(0), grey_scene(90), 2, exposure)
        first, second = (sensor.frame(np.random.default_rng(k)).astype(float) for k in (1, 2))
        return first - second

    dim, bright = difference(0.3).std(), difference(2.0).std()
    assert dim > 1.0
    assert bright > 1.3 * dim


def test_bright_light_saturates_instead_of_wrapping() -> None:
    bayer = BayerSensor(np.random.default_rng(0), grey_scene(200), 2, 4.0).frame(np.random.default_rng(1))
    assert bayer[200:280, 280:360].min() > 240
