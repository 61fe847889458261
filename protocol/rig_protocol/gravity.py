"""Down, as the accelerometer beside a camera felt it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from rig_protocol.errors import DataError

# How far a Kinect's accelerometer errs, one sigma an axis, the same from reading to reading. Microsoft states
# 1° at best and up to 3° of drift over the operating temperature (Kinect for Windows SDK 1.8, Accelerometer);
# a room spans a third of that. One unit was measured (ROS kinect_aux) to read 37, 15 and 3 counts of 819 a g
# where it should read none: 1.6° root mean square.
KINECT_SIGMA_DEG = 1.5

_UNIT_TOLERANCE = 0.01
_MIN_SIGMA_DEG, _MAX_SIGMA_DEG = 0.01, 45.0
# Readings at rest differ by their noise, a few tenths of a degree.
_TURNED_DEG = 1.0


@dataclass(frozen=True, slots=True)
class Gravity:
    """Down at one moment: a unit vector in the colour camera's frame, `sigma_deg` its σ on each axis."""

    down: tuple[float, float, float]
    sigma_deg: float = KINECT_SIGMA_DEG

    def __post_init__(self) -> None:
        """DataError when it is no unit vector, or its uncertainty out of reason."""
        if not abs(math.hypot(*self.down) - 1) <= _UNIT_TOLERANCE:
            raise DataError(f"gravity points along {self.down}, which is no unit vector")
        if not _MIN_SIGMA_DEG <= self.sigma_deg <= _MAX_SIGMA_DEG:
            raise DataError(f"gravity.sigma_deg must be from {_MIN_SIGMA_DEG} to {_MAX_SIGMA_DEG}")

    @classmethod
    def along(cls, vector: npt.NDArray[np.float64], sigma_deg: float = KINECT_SIGMA_DEG) -> Self:
        """Down in the direction of a vector (3,) of any length; DataError where it has none."""
        x, y, z = vector.tolist()
        length = math.hypot(x, y, z)
        if not 0 < length < math.inf:
            raise DataError(f"gravity cannot point along {vector}")
        return cls((x / length, y / length, z / length), sigma_deg)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, for JSON files and the heartbeat."""
        return {"down": list(self.down), "sigma_deg": self.sigma_deg}

    @classmethod
    def from_dict(cls, values: Any) -> Self:
        """Read what `to_dict` writes; DataError when it is malformed."""
        if not isinstance(values, Mapping):
            raise DataError("gravity must hold `down` and `sigma_deg`")
        down, sigma_deg = values.get("down"), values.get("sigma_deg")
        numbers = [*down, sigma_deg] if isinstance(down, list) else []
        if len(numbers) != 4 or not all(map(_is_number, numbers)):
            raise DataError("gravity needs three finite numbers `down` and a number `sigma_deg`")
        x, y, z, sigma = map(float, numbers)
        return cls((x, y, z), sigma)


def common_gravity(felt: Sequence[Gravity]) -> Gravity | None:
    """The mean of what one camera felt over time, no more certain than each: they err alike.

    None where it felt nothing, or where it was turned meanwhile.
    """
    if not felt:
        return None
    if len(set(felt)) == 1:  # as in a rig folder, whose frames all tell the mean: bit for bit the same again
        return felt[0]
    downs = np.array([one.down for one in felt])
    mean = downs.mean(axis=0)
    if np.linalg.norm(downs - mean, axis=1).max() > np.deg2rad(_TURNED_DEG):
        return None
    return Gravity.along(mean, max(one.sigma_deg for one in felt))


def _is_number(value: Any) -> bool:
    # A bound, because an integer of a thousand digits is no float.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e3
