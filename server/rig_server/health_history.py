"""HealthHistory: the last minutes of every camera's health, for plots; its memory is bounded."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from rig_server.metrics import RigStatus

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Quantity:
    """What is plotted: its title and unit, and whether every camera has one or the rig as a whole."""

    title: str
    unit: str
    of: Literal["camera", "rig"]


QUANTITIES: Mapping[str, Quantity] = {
    "fps": Quantity("frame rate", "1/s", "camera"),
    "loss": Quantity("lost frames", "share", "camera"),
    "damaged": Quantity("damaged frames", "1/s", "camera"),
    "temperature_c": Quantity("temperature", "°C", "camera"),
    "clock_error_us": Quantity("clock error", "µs", "camera"),
    "drift_mm": Quantity("moved by", "mm", "camera"),
    "drift_deg": Quantity("turned by", "°", "camera"),
    "sets_per_s": Quantity("sets", "1/s", "rig"),
    "spread_ms": Quantity("spread of a set", "ms", "rig"),
    "record_mb_s": Quantity("recorded", "MB/s", "rig"),
}


class HealthHistory:
    """The last minutes of every camera's health, sampled from RigStatus; memory bounded."""

    def __init__(self, seconds: float = 600.0, every_s: float = 1.0) -> None:
        """Keep one sample every `every_s` for `seconds`."""

    def sample(self, status: RigStatus, now_s: float) -> None:
        """Take a sample, if one is due; `now_s` is of any monotonic clock."""

    def series(self, quantity: str, camera_id: int | None = None) -> tuple[Array, Array]:
        """Times in s, oldest first, and values, NaN where unknown; one thread may ask while another samples.

        KeyError for a quantity that is not in `QUANTITIES`, ValueError where it needs a camera and none is
        given. A camera that nobody knows is unknown throughout.
        """
        return np.empty(0), np.empty(0)
