"""The rig's status in sentences: a few figures that always stand there, and a line for each trouble."""

from collections.abc import Mapping

from rig_calib.drift.words import moved_message
from rig_protocol.recorder import RecordingStatus
from rig_server.durations import (
    EXPOSURE_TO_RECEIVED,
    RECEIVED_TO_DECODED,
    RECEIVED_TO_DELIVERED,
    UNCERTAINTY,
)
from rig_server.histogram import HistogramSnapshot
from rig_server.metrics import RigStatus

_STAGES = {
    EXPOSURE_TO_RECEIVED: "arrival",
    RECEIVED_TO_DECODED: "decoding",
    RECEIVED_TO_DELIVERED: "delivery",
}
_MOST_CAUSES = 4  # that fit a line


def summary(status: RigStatus) -> tuple[list[str], list[str]]:
    """Lines of figures, and lines of troubles, of which a healthy rig has none."""
    figures, latency = [_sets(status)], _latency(status.recent)
    if latency:
        figures.append(latency)
    if status.link is not None:
        figures.append(status.link)
    if status.recording is not None and status.recording.ended is None:
        figures.append(_recording(status.recording))
    names = {camera.camera_id: camera.name for camera in status.cameras}
    missing = [names.get(camera_id, str(camera_id)) for camera_id in status.often_missing]
    troubles = {
        "often missing": ", ".join(missing),
        "waiting": _waiting(status),
        "dropped": _counts(status.dropped),
        "frames not recorded": "" if status.recording is None else str(status.recording.dropped or ""),
        "without a slot (rig-server assign)": ", ".join(map(str, status.unassigned)),
        "rejected datagrams": _counts(status.rejected, _MOST_CAUSES),
    }
    return figures, [f"{what}: {which}" for what, which in troubles.items() if which]


def alarms(status: RigStatus) -> list[str]:
    """What must not be overlooked: cameras that moved, and a drift watch that has ended."""
    told = []
    if status.recording is not None and status.recording.ended is not None:
        told.append(f"recording {status.recording.path} ended: {status.recording.ended}")
    if status.drift is None:
        return told
    told += [moved_message(camera, status.drift.names) for camera in status.drift.status.moved]
    if status.drift.failure is not None:
        told.append(f"the drift watch has ended: {status.drift.failure}; start the server again")
    return told


def recorded(recording: RecordingStatus) -> str:
    """How a recording was that has been ended."""
    told = f"recorded {_duration(recording.seconds)}, {recording.bytes / 1e9:.2f} GB to {recording.path}"
    if recording.dropped:
        told += f"; the disk was too slow for {recording.dropped} frames"
    return told + (f"; it had ended before: {recording.ended}" if recording.ended is not None else "")


def _recording(recording: RecordingStatus) -> str:
    """How long, how much, and for how long the disk has room at this rate."""
    rate = recording.bytes_per_s
    known = recording.seconds >= 2 and rate > 0  # before, the rate is that of the file's head
    left = f", room for {_duration(max(recording.free_bytes, 0) / rate)}" if known else ""
    size = f"{recording.bytes / 1e9:.2f} GB, {rate / 1e6:.0f} MB/s"
    return f"recording {recording.path.name}: {_duration(recording.seconds)}, {size}{left}"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes}:{rest:02d}" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def _sets(status: RigStatus) -> str:
    spread = "" if status.spread_ms is None else f", spread {status.spread_ms:.1f} ms"
    uncertainty_ms = _quantile_ms(status.recent.get(UNCERTAINTY), 0.5)
    error = "" if uncertainty_ms is None else f" ± {1000 * uncertainty_ms:.0f} µs"
    counts = f"{status.complete} complete, {status.partial} partial"
    return f"{status.sets_per_s:.1f} sets/s{spread}{error}, {counts}"


def _latency(recent: Mapping[str, HistogramSnapshot]) -> str:
    parts = []
    for stage, words in _STAGES.items():
        half, most = (_quantile_ms(recent.get(stage), share) for share in (0.5, 0.99))
        if half is not None and most is not None:
            parts.append(f"{words} {_short(half)}/{_short(most)}")
    return f"p50/p99 ms: {', '.join(parts)}" if parts else ""


def _short(duration_ms: float) -> str:
    return f"{duration_ms:.1f}" if duration_ms < 10 else f"{duration_ms:.0f}"


def _waiting(status: RigStatus) -> str:
    """Frames wait in the synchroniser for one another by design: they are no trouble."""
    queues = {name: length for name, length in status.queues.items() if name != "synchroniser"}
    return _counts(queues | {"receive buffer MiB": status.unread_bytes >> 20})


def _counts(counts: Mapping[str, int], most: int | None = None) -> str:
    """What is not zero; the largest `most` of them, largest first, and how many more there are."""
    shown = [(name, count) for name, count in counts.items() if count]
    if most is not None:
        shown.sort(key=lambda item: -item[1])
    words = [f"{name.replace('_', ' ')} {count}" for name, count in shown[:most]]
    if len(shown) > len(words):
        words.append(f"{len(shown) - len(words)} more")
    return ", ".join(words)


def _quantile_ms(seen: HistogramSnapshot | None, share: float) -> float | None:
    quantile_ns = None if seen is None else seen.quantile_ns(share)
    return None if quantile_ns is None else quantile_ns / 1e6
