"""Rules of the joint estimate's priors."""

import numpy as np
import pytest

from rig_calib.depth_model import depth_basis, depth_grid
from rig_calib.projection import from_pixels
from rig_calib.rig_adjustment import bias_sigma
from rig_calib.settings import CalibrationSettings
from rig_protocol.camera import CameraModel

GRID = depth_grid(CameraModel(), "depth")


def test_every_shape_of_depth_bias_is_as_likely_to_reach_one_height_over_the_image() -> None:
    settings = CalibrationSettings()
    v, u = np.mgrid[0 : GRID.intrinsics.height, 0 : GRID.intrinsics.width]
    x, y = from_pixels(GRID.intrinsics, np.stack([u.ravel(), v.ravel()], axis=1).astype(float)).T
    heights = np.ptp(depth_basis(x, y, settings.bias_terms)[:, 1:], axis=0)
    sigma = bias_sigma(GRID, settings)
    assert sigma[0] == settings.bias_scale_sigma
    np.testing.assert_allclose(sigma[1:] * heights, settings.bias_shape_sigma, rtol=0.01)


@pytest.mark.parametrize("terms", [0, 1, 3])
def test_there_are_as_many_priors_as_terms(terms: int) -> None:
    assert len(bias_sigma(GRID, CalibrationSettings(bias_terms=terms))) == terms
