"""What the operator is told of the running rig: one line a camera, and the sets."""

import statistics
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rig_server.assembler import SetRecord
from rig_server.synchroniser import IncompleteSet

TEMPERATURE = "temperature_c"  # the gauge of an agent's heartbeat that has a column of its own
_RATE_WINDOW_NS = 3_000_000_000


@dataclass(frozen=True, slots=True)
class CameraMetrics:
    """One camera. Rates are of the last three seconds, counts since the server started.

    `late`: frames whose set had gone. `corrupt`: frames whose checksum or payload failed.
    `duplicate`: fragments that came twice. `clock_error_us`: standard uncertainty of its stamps in rig time.
    """

    camera_id: int
    name: str
    connected: bool
    fps: float = 0.0
    frames: int = 0
    lost: int = 0
    late: int = 0
    damaged: int = 0
    duplicate: int = 0
    corrupt: int = 0
    clock_error_us: float | None = None
    temperature_c: float | None = None

    @property
    def loss(self) -> float:
        """Share of the sent frames that did not arrive whole."""
        return self.lost / (self.lost + self.frames) if self.lost else 0.0


@dataclass(frozen=True, slots=True)
class RigStatus:
    """The rig at one moment; `dropped` names frames, sets and datagrams lost beside the cameras' own."""

    cameras: tuple[CameraMetrics, ...]
    complete: int = 0
    partial: int = 0
    sets_per_s: float = 0.0
    spread_ms: float | None = None
    often_missing: tuple[int, ...] = ()
    dropped: Mapping[str, int] = field(default_factory=dict)

    @property
    def connected(self) -> int:
        """How many cameras are connected."""
        return sum(camera.connected for camera in self.cameras)


class RateMeter:
    """Frames a second of every camera, from their counts at moments up to three seconds ago."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, Mapping[int, int]]] = deque()

    def update(self, frames: Mapping[int, int], now_ns: int) -> dict[int, float]:
        """Rates by camera id; 0.0 until two samples hold the camera."""
        self._samples.append((now_ns, frames))
        while self._samples[0][0] < now_ns - _RATE_WINDOW_NS and len(self._samples) > 2:
            self._samples.popleft()
        return {camera_id: self._rate(camera_id) for camera_id in frames}

    def _rate(self, camera_id: int) -> float:
        known = [(time_ns, counts[camera_id]) for time_ns, counts in self._samples if camera_id in counts]
        (start_ns, first), (end_ns, last) = known[0], known[-1]
        return (last - first) * 1e9 / (end_ns - start_ns) if end_ns > start_ns else 0.0


def summarise_sets(
    recent: Sequence[SetRecord], now_ns: int, incomplete: Sequence[IncompleteSet] = ()
) -> tuple[float, float | None, tuple[int, ...]]:
    """Sets a second, median spread in ms, and the cameras missing from at least a tenth, worst first.

    `incomplete`: sets that did not go out; their cameras are named too.
    """
    since_ns = now_ns - _RATE_WINDOW_NS
    fresh = [record for record in recent if record.delivered_ns >= since_ns]
    lacking = [record.missing for record in fresh]
    lacking += [record.missing for record in incomplete if record.decided_ns >= since_ns]
    ranked = _often_missing(lacking)
    if not fresh:
        return 0.0, None, ranked
    elapsed_ns = max(now_ns - fresh[0].delivered_ns, 1)
    rate = (len(fresh) - 1) * 1e9 / elapsed_ns
    return rate, statistics.median(record.spread_ns for record in fresh) / 1e6, ranked


def _often_missing(lacking: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
    absent = Counter(camera_id for missing in lacking for camera_id in missing)
    often = [camera_id for camera_id, count in absent.items() if 10 * count >= len(lacking)]
    return tuple(sorted(often, key=lambda camera_id: (-absent[camera_id], camera_id)))
