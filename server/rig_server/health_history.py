"""HealthHistory: the last minutes of every camera's health, for plots; its memory is bounded."""

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from rig_calib.drift.watch import CameraDrift
from rig_protocol.recorder import RecordingStatus
from rig_server.config import MAX_CAMERAS
from rig_server.metrics import CameraMetrics, RigStatus

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
_COLUMNS = {
    of: [name for name, quantity in QUANTITIES.items() if quantity.of == of] for of in ("camera", "rig")
}
_RIG = -1  # its place among the cameras' ids
_EARLY = 0.1  # share of the interval by which a sample may come early: whoever asks has a clock that jitters


class HealthHistory:
    """The last minutes of every camera's health, sampled from RigStatus; memory bounded.

    Counts become rates over the time since the sample before. One that went back, because its agent or the
    recording began anew, is taken to have begun at zero.
    """

    def __init__(self, seconds: float = 600.0, every_s: float = 1.0) -> None:
        """Keep one sample every `every_s` for `seconds`."""
        self._every_s = every_s
        self._length = max(1, round(seconds / every_s))
        self._lock = threading.Lock()  # guards all that follows
        self._count = 0
        self._time_s = np.full(self._length, np.nan)
        self._values: dict[int, Array] = {_RIG: self._unknown(_RIG)}
        self._cameras: dict[int, CameraMetrics] = {}
        self._recorded: tuple[Path, int] | None = None
        self._sampled_s: float | None = None

    def sample(self, status: RigStatus, now_s: float) -> None:
        """Take a sample, if one is due; `now_s` is of any monotonic clock."""
        with self._lock:
            before_s = self._sampled_s
            if before_s is not None and now_s - before_s < (1.0 - _EARLY) * self._every_s:
                return
            passed_s = np.nan if before_s is None else now_s - before_s
            place = self._count % self._length
            self._time_s[place] = now_s
            for values in self._values.values():
                values[:, place] = np.nan
            self._values[_RIG][:, place] = self._of_rig(status, passed_s)
            for camera_id, sampled in self._of_cameras(status, passed_s).items():
                self._values.setdefault(camera_id, self._unknown(camera_id))[:, place] = sampled
            self._forget_who_left()
            self._count, self._sampled_s = self._count + 1, now_s

    def series(self, quantity: str, camera_id: int | None = None) -> tuple[Array, Array]:
        """Times in s, oldest first, and values, NaN where unknown; one thread may ask while another samples.

        KeyError for a quantity that is not in `QUANTITIES`, ValueError where it needs a camera and none is
        given. A camera that nobody knows is unknown throughout.
        """
        of = QUANTITIES[quantity].of
        if of == "camera" and camera_id is None:
            raise ValueError(f"{quantity} is one of each camera: name one")
        with self._lock:
            held = min(self._count, self._length)
            order = np.arange(self._count - held, self._count) % self._length
            values = self._values.get(_RIG if camera_id is None or of == "rig" else camera_id)
            if values is None:
                return self._time_s[order], np.full(held, np.nan)
            return self._time_s[order], values[_COLUMNS[of].index(quantity), order]

    def _of_rig(self, status: RigStatus, passed_s: float) -> list[float]:
        recorded_mb = self._recorded_bytes(status.recording) / 1e6
        return [status.sets_per_s, _known(status.spread_ms), recorded_mb / passed_s]

    def _recorded_bytes(self, recording: RecordingStatus | None) -> float:
        """Since the sample before; NaN while nobody records."""
        before = self._recorded
        self._recorded = None if recording is None else (recording.path, recording.bytes)
        if recording is None:
            return np.nan
        same = before is not None and before[0] == recording.path
        return _since(before[1] if same and before is not None else 0, recording.bytes)

    def _of_cameras(self, status: RigStatus, passed_s: float) -> dict[int, list[float]]:
        """Of those that are connected; of the others nothing is known."""
        drifts = {} if status.drift is None else {one.camera: one for one in status.drift.status.cameras}
        connected = {camera.camera_id: camera for camera in status.cameras if camera.connected}
        before, self._cameras = self._cameras, dict(list(connected.items())[:MAX_CAMERAS])
        return {
            camera_id: _of_camera(camera, before.get(camera_id), drifts.get(camera_id), passed_s)
            for camera_id, camera in self._cameras.items()
        }

    def _unknown(self, camera_id: int) -> Array:
        return np.full((len(_COLUMNS["rig" if camera_id == _RIG else "camera"]), self._length), np.nan)

    def _forget_who_left(self) -> None:
        """Cameras of which the whole window knows nothing."""
        for camera_id in [i for i, values in self._values.items() if i != _RIG and np.isnan(values).all()]:
            del self._values[camera_id]


def _of_camera(
    now: CameraMetrics, before: CameraMetrics | None, drift: CameraDrift | None, passed_s: float
) -> list[float]:
    """In the order of `QUANTITIES`."""
    loss = damaged = np.nan
    if before is not None:
        arrived, lost = _since(before.frames, now.frames), _since(before.lost, now.lost)
        loss = lost / (arrived + lost) if arrived + lost else np.nan
        damaged = _since(before.damaged, now.damaged) / passed_s
    seen = drift is not None and drift.state in ("in place", "moved")
    drift_mm, drift_deg = (drift.mm, drift.deg) if drift is not None and seen else (np.nan, np.nan)
    measured = (_known(now.temperature_c), _known(now.clock_error_us))
    return [now.fps, loss, damaged, *measured, drift_mm, drift_deg]


def _since(before: int, now: int) -> int:
    """By how much a count rose; one that went back has begun anew."""
    return now - before if now >= before else now


def _known(value: float | None) -> float:
    return np.nan if value is None else value
