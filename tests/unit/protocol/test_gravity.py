"""Down: what is a direction, what several readings of one camera have in common."""

import math
from typing import Any

import numpy as np
import pytest

from rig_protocol.errors import DataError
from rig_protocol.gravity import Gravity, common_gravity

GOOD: dict[str, Any] = {"down": [0.6, 0.8, 0.0], "sigma_deg": 1.5}


def tilted(deg: float, sigma_deg: float = 1.5) -> Gravity:
    angle = np.deg2rad(deg)
    return Gravity.along(np.array([np.cos(angle), np.sin(angle), 0.0]), sigma_deg)


def test_gravity_survives_its_plain_form() -> None:
    assert Gravity.from_dict(tilted(12).to_dict()) == tilted(12)


@pytest.mark.parametrize(
    "values",
    [
        [],
        "down",
        {},
        GOOD | {"down": None},
        GOOD | {"down": [1.0, 0.0]},
        GOOD | {"down": [1.0, 0.0, 0.0, 0.0]},
        GOOD | {"down": [0.0, 0.0, 0.0]},
        GOOD | {"down": [0.0, 0.0, 9.81]},
        GOOD | {"down": [math.nan, 0.0, 1.0]},
        GOOD | {"down": [math.inf, 0.0, 1.0]},
        GOOD | {"down": [True, 0.0, 0.0]},
        GOOD | {"down": ["1", 0.0, 0.0]},
        GOOD | {"down": [10**400, 0.0, 0.0]},
        GOOD | {"sigma_deg": 0.0},
        GOOD | {"sigma_deg": -1.0},
        GOOD | {"sigma_deg": 90.0},
        GOOD | {"sigma_deg": math.nan},
        {"down": GOOD["down"]},
    ],
    ids=str,
)
def test_what_is_no_unit_vector_with_an_uncertainty_is_malformed(values: Any) -> None:
    with pytest.raises(DataError, match="gravity"):
        Gravity.from_dict(values)


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (math.nan, 0.0, 0.0), (math.inf, 0.0, 0.0)])
def test_nothing_points_along_a_vector_without_direction(vector: tuple[float, ...]) -> None:
    with pytest.raises(DataError, match="cannot point"):
        Gravity.along(np.array(vector))


def test_readings_of_one_camera_err_alike_so_that_their_mean_is_no_more_certain() -> None:
    common = common_gravity([tilted(10.2, 1.0), tilted(9.8, 2.0), tilted(10.0, 1.0)])
    assert common is not None
    np.testing.assert_allclose(common.down, tilted(10).down, atol=1e-4)
    assert common.sigma_deg == 2.0


def test_a_camera_that_was_turned_meanwhile_has_no_common_down() -> None:
    assert common_gravity([tilted(0), tilted(0), tilted(5)]) is None


def test_a_camera_that_felt_nothing_has_no_down() -> None:
    assert common_gravity([]) is None
