"""What the operator is told of the running rig: one line a camera, and the sets."""

import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rig_calib.drift.watch import DriftStatus
from rig_protocol.clock_sync import ClockEstimate
from rig_protocol.recorder import RecordingStatus
from rig_protocol.synchroniser import IncompleteSet
from rig_server.assembler import SetRecord
from rig_server.histogram import HistogramSnapshot
from rig_server.sample_window import SampleWindow
from rig_server.unassigned import UnassignedAgent

TEMPERATURE = "temperature_c"  # the gauge of an agent's heartbeat that has a column of its own
_RATE_WINDOW_NS = 3_000_000_000
_RATE_SPACING_NS = 100_000_000


@dataclass(frozen=True, slots=True)
class CameraMetrics:
    """One camera. Rates are of the last three seconds, counts since the server started.

    `late`: frames whose set had gone. `corrupt`: frames whose seal or payload failed.
    `duplicate`: fragments that came twice. `resent`: fragments that came because we asked for them again.
    `clock_error_us`: standard uncertainty of its stamps in rig time. `counters`: all of `CameraCounters`, by
    name. `dropped`: frames that came whole and entered no set, by cause. `gauges`: what the agent tells of
    itself.
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
    resent: int = 0
    clock_error_us: float | None = None
    temperature_c: float | None = None
    counters: Mapping[str, int] = field(default_factory=dict)
    dropped: Mapping[str, int] = field(default_factory=dict)
    gauges: Mapping[str, float] = field(default_factory=dict)
    clock: ClockEstimate | None = None

    @property
    def loss(self) -> float:
        """Share of the sent frames that did not arrive whole."""
        return self.lost / (self.lost + self.frames) if self.lost else 0.0


@dataclass(frozen=True, slots=True)
class DriftReport:
    """What the drift watch says: of every camera, and how many sets it looked at and passed over being busy.

    `names` by camera id are the calibration's; `failure`: why it watches no more.
    """

    status: DriftStatus
    names: Mapping[int, str]
    passed_over: int = 0
    failure: str | None = None


@dataclass(frozen=True, slots=True)
class RigStatus:
    """The rig at one moment.

    `dropped` names frames, sets and datagrams lost beside the cameras' own, `rejected` datagrams that belong
    to no camera, by cause. `repeated`: frames that went out once more. `queues`: frames or sets that wait, by
    place; `unread_bytes`: how much of the kernel's receive buffer is taken. `durations`: histograms since the
    start, by the names in `rig_server.durations`; `recent`: the same of the last half minute. `link`: what is
    sent and what that takes, in words. `drift`: what the drift watch says, None where nobody watches.
    `unassigned`: agents that hold the key and have no slot. `recording`: None where nobody records.
    `turns`: rises while the receiver is alive, at least once a second.
    """

    cameras: tuple[CameraMetrics, ...]
    complete: int = 0
    partial: int = 0
    sets_per_s: float = 0.0
    spread_ms: float | None = None
    often_missing: tuple[int, ...] = ()
    dropped: Mapping[str, int] = field(default_factory=dict)
    repeated: int = 0
    rejected: Mapping[str, int] = field(default_factory=dict)
    queues: Mapping[str, int] = field(default_factory=dict)
    unread_bytes: int = 0
    durations: Mapping[str, HistogramSnapshot] = field(default_factory=dict)
    recent: Mapping[str, HistogramSnapshot] = field(default_factory=dict)
    link: str | None = None
    drift: DriftReport | None = None
    authenticated: bool = False
    unassigned: tuple[UnassignedAgent, ...] = ()
    recording: RecordingStatus | None = None
    turns: int = 0

    @property
    def connected(self) -> int:
        """How many cameras are connected."""
        return sum(camera.connected for camera in self.cameras)


class RateMeter:
    """Frames a second of every camera, from their counts at moments up to three seconds ago."""

    def __init__(self) -> None:
        self._window: SampleWindow[Mapping[int, int]] = SampleWindow(_RATE_WINDOW_NS, _RATE_SPACING_NS)

    def update(self, frames: Mapping[int, int], now_ns: int) -> dict[int, float]:
        """Rates by camera id; 0.0 until two samples hold the camera."""
        samples = self._window.add(frames, now_ns)
        return {camera_id: _rate(camera_id, samples) for camera_id in frames}


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


def _rate(camera_id: int, samples: Sequence[tuple[int, Mapping[int, int]]]) -> float:
    known = [(time_ns, counts[camera_id]) for time_ns, counts in samples if camera_id in counts]
    (start_ns, first), (end_ns, last) = known[0], known[-1]
    return (last - first) * 1e9 / (end_ns - start_ns) if end_ns > start_ns else 0.0
