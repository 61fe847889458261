"""Zero-plane data to a depth model."""

import math

import pytest

from rig_agent.sources.factory_model import camera_model
from rig_agent.sources.libfreenect import ZeroPlane
from rig_protocol.camera import CameraModel, RawDepthModel

TYPICAL = ZeroPlane(7.5, 120.0, 0.1042, 200.0)


def millimetres_of_libfreenect(raw: int, plane: ZeroPlane) -> float:
    """freenect_raw_to_mm of libfreenect's registration.c, before it rounds."""
    metric = ((raw - 4 * plane.const_shift) / 4 - 0.375) * plane.reference_pixel_size_cm
    return 10 * (
        metric * plane.reference_distance_cm / (plane.emitter_distance_cm - metric)
        + plane.reference_distance_cm
    )


@pytest.mark.parametrize("raw", [400, 600, 800, 1000])
@pytest.mark.parametrize("plane", [TYPICAL, ZeroPlane(7.6, 118.0, 0.1030, 198.0)])
def test_the_model_is_libfreenects_conversion_in_closed_form(raw: int, plane: ZeroPlane) -> None:
    model = camera_model(plane)
    metres = model.raw_model.numerator_m / (model.raw_model.offset - raw)
    assert model.source == "default"
    assert metres == pytest.approx(millimetres_of_libfreenect(raw, plane) / 1000, rel=1e-12)


def test_the_typical_unit_is_the_documented_default_of_the_disparity_model() -> None:
    model, default = camera_model(TYPICAL).raw_model, RawDepthModel()
    assert (model.numerator_m, model.offset) == pytest.approx((default.numerator_m, default.offset), rel=1e-5)


@pytest.mark.parametrize(
    "plane",
    [
        None,
        ZeroPlane(0.0, 0.0, 0.0, 0.0),
        ZeroPlane(7.5, 120.0, -0.1, 200.0),
        ZeroPlane(math.nan, 120.0, 0.1042, 200.0),
        ZeroPlane(7.5, math.inf, 0.1042, 200.0),
        ZeroPlane(7.5, 120.0, 0.2, 200.0),
        TYPICAL._replace(const_shift=0.0),
    ],
)
def test_data_that_no_kinect_has_gives_the_defaults_and_says_so(plane: ZeroPlane | None) -> None:
    model = camera_model(plane)
    assert model.source == "default"
    assert model.raw_model == CameraModel().raw_model
    assert model.depth == CameraModel().depth
