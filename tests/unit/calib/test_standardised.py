"""Residuals of an adjustment follow the standard normal distribution once their redundancy is counted."""

import numpy as np
import pytest

from rig_calib.rig_adjustment import AdjustedRig, adjust_rig
from rig_calib.settings import CalibrationSettings
from rig_calib.standardised import StandardisedResiduals
from rig_protocol.poses import inverse
from support.synthetic_rig import SyntheticRig, true_matches

DISPARITY_SIGMA = 0.4


@pytest.fixture(scope="module")
def rig() -> AdjustedRig:
    scene = SyntheticRig(cameras=3, points=300)
    cameras = {c: scene.observe(c, pixel_sigma=0.304, disparity_sigma=DISPARITY_SIGMA) for c in range(3)}
    matches = {pair: true_matches(cameras[pair[0]], cameras[pair[1]]) for pair in ((0, 1), (1, 2))}
    start = {c: inverse(scene.truth[0]) @ T for c, T in scene.truth.items()}
    return adjust_rig(cameras, matches, start, None, CalibrationSettings(bias_terms=1, pixel_sigma=0.3))


def test_errors_of_the_assumed_size_have_a_spread_of_one(rig: AdjustedRig) -> None:
    """Raw residuals of points that two cameras see are smaller by √2; crowding adds to what is assumed."""
    residuals = StandardisedResiduals.of(rig)
    pixel, disparity = residuals.of_pair(0, 1)
    assert 0.75 < np.std(pixel) < 1.15
    assert 0.6 < np.std(disparity) < 1.15
    assert np.std(rig.adjustment.residuals[:, :2]) < 0.8 * np.std(pixel)


def test_a_pair_shows_only_points_that_both_cameras_see(rig: AdjustedRig) -> None:
    residuals = StandardisedResiduals.of(rig)
    seen = rig.scene.observations
    common = set(seen.point[seen.camera == 0]) & set(seen.point[seen.camera == 1])
    pixel, disparity = residuals.of_pair(0, 1)
    assert len(pixel) == 4 * len(common)
    assert len(disparity) == 2 * len(common)
    assert residuals.of_pair(0, 2)[0].size == 0


def test_a_disparity_that_nothing_checks_says_nothing(rig: AdjustedRig) -> None:
    seen = rig.scene.observations
    values = StandardisedResiduals.of(rig).values[:, 2]
    alone = ~np.isfinite(seen.disparity)
    assert np.isnan(values[alone]).all()
