"""Rules of the camera model's plain form."""

import copy
import math
from typing import Any

import numpy as np
import pytest

from rig_protocol.camera import CameraModel, Intrinsics, RawDepthModel
from rig_protocol.errors import DataError


def test_a_model_survives_its_plain_form() -> None:
    model = CameraModel(
        color=Intrinsics(517.3, 516.5, 318.6, 255.3, dist=(0.26, -0.95, -0.005, 0.002, 1.16)),
        raw_model=RawDepthModel(348.0, 1091.5),
        source="factory",
    )
    again = CameraModel.from_dict(model.to_dict())
    assert again.to_dict() == model.to_dict()
    assert again.color == model.color


def test_a_camera_without_depth_stays_without() -> None:
    again = CameraModel.from_dict(CameraModel(depth=None, T_color_depth=None).to_dict())
    assert again.depth is None
    assert again.T_color_depth is None


def test_the_shared_disparity_model_yields_to_the_cameras_own() -> None:
    plain: dict[str, Any] = CameraModel().to_dict()
    shared = RawDepthModel(350.0, 1090.0)
    own = {**plain, "raw_model": {"numerator_m": 348.0, "offset": 1091.5}}
    without = {key: value for key, value in plain.items() if key != "raw_model"}
    assert CameraModel.from_dict(own, shared).raw_model == RawDepthModel(348.0, 1091.5)
    assert CameraModel.from_dict(without, shared).raw_model == shared


def test_the_default_disparity_model_is_the_factory_conversion() -> None:
    model = RawDepthModel()
    assert model.numerator_m / (model.offset - 800) == pytest.approx(1.1938, abs=1e-4)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("color", "fx"), 0.0),
        (("color", "fx"), math.nan),
        (("color", "fx"), "wide"),
        (("color", "width"), 10**9),
        (("color", "dist"), [0.1]),
        (("color",), None),
        (("depth",), 7),
        (("T_color_depth",), [[1, 2], [3, 4]]),
        (("T_color_depth",), np.diag([2.0, 1, 1, 1]).tolist()),
        (("raw_model", "numerator_m"), -1.0),
        (("raw_model", "offset"), math.inf),
        (("source",), "hearsay"),
    ],
)
def test_a_lying_model_is_refused(path: tuple[str, ...], value: object) -> None:
    plain: dict[str, Any] = copy.deepcopy(CameraModel().to_dict())
    target = plain
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    with pytest.raises(DataError):
        CameraModel.from_dict(plain)
