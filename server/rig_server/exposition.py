"""The rig's status as Prometheus metrics: names, help and values (docs/monitoring.md)."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from rig_protocol.recorder import RecordingStatus
from rig_server.durations import SPREAD, STAGES, UNCERTAINTY
from rig_server.histogram import HistogramSnapshot
from rig_server.metrics import TEMPERATURE, CameraMetrics, DriftReport, RigStatus

# Fields of CameraCounters that have a metric of their own: its name and what it counts.
_COUNTERS = {
    "sessions": ("rig_sessions", "Sessions that the camera began."),
    "bytes": ("rig_received_bytes", "Bytes of the camera's datagrams."),
    "fragments": ("rig_fragments_received", "Fragments that entered reassembly."),
    "frames": ("rig_frames_received", "Frames that came whole and in time."),
    "damaged": ("rig_frames_damaged", "Received frames that the agent flagged as damaged."),
    "requested": ("rig_fragments_requested", "Fragments that the server asked for again."),
    "resent": ("rig_fragments_resent", "Requested fragments that then came."),
    "late": ("rig_fragments_late", "Fragments of frames that had been delivered or given up."),
    "duplicate": ("rig_fragments_duplicate", "Fragments that came twice."),
    "clock_steps": ("rig_clock_steps", "Jumps of the camera's clock."),
    "system_clock_disagreements": (
        "rig_system_clock_disagreements",
        "System clocks that called themselves disciplined and that the exchange disproved.",
    ),
}
LOST_CAUSES = ("missing", "incomplete", "evicted", "corrupt", "unexpected_codec", "untimed", "overflow")
_DROPPED_CAUSES = ("oversized", "bad_fragment", "bad_clock_reply")
# What RigStatus.dropped calls it; frames not decoded in time are told by camera.
DROPPED = {
    "incomplete sets": ("rig_sets_incomplete", "Sets that the policy strict held back for want of a camera."),
    "sets not taken": ("rig_sets_not_taken", "Sets that gave way to newer ones because nobody took them."),
    "frames left out of sets": ("rig_frames_left_out", "Frames for which no set had room."),
    "frames of implausible time": ("rig_frames_implausible", "Frames whose time cannot be true."),
    "datagrams by the kernel": (
        "rig_kernel_dropped_datagrams",
        "Datagrams that found the receive buffer full.",
    ),
    "answers that the network refused": (
        "rig_unsent_datagrams",
        "Control datagrams that the network refused.",
    ),
}
# An agent chooses the names of its gauges; so many of so many characters are told.
_MAX_GAUGES = 32
_MAX_GAUGE_NAME = 48


class RigCollector(Collector):
    """Reads one status for each scrape."""

    def __init__(self, read_status: Callable[[], RigStatus]) -> None:
        self._read_status = read_status

    def collect(self) -> Iterator[Metric]:
        """All metrics as of now."""
        return families(self._read_status())

    def describe(self) -> Iterator[Metric]:
        """Names and types, which do not depend on the status."""
        return families(RigStatus(()))


def families(status: RigStatus) -> Iterator[Metric]:
    """All metrics of a status; the same names whatever it holds."""
    yield from _arrivals(status.cameras)
    yield from _clocks(status.cameras)
    yield from _agents(status.cameras)
    yield from _sets(status)
    yield from _rig(status)
    yield from _recording(status.recording)
    yield from _drift(status.drift)


def _arrivals(cameras: Iterable[CameraMetrics]) -> Iterator[Metric]:
    connected = _gauge("rig_camera_connected", "1 while the camera is connected.", "camera")
    counted = {name: _counter(*about, "camera") for name, about in _COUNTERS.items()}
    lost = _counter("rig_frames_lost", "Frames that were sent and did not arrive.", "camera", "cause")
    dropped = _counter("rig_frames_dropped", "Received frames that entered no set.", "camera", "cause")
    refused = _counter(
        "rig_datagrams_dropped", "Datagrams of a session that were no good.", "camera", "cause"
    )
    others = _counter("rig_camera_events", "What else is counted of a camera.", "camera", "event")
    for camera in cameras:
        connected.add_metric([camera.name], camera.connected)
        for name, count in camera.counters.items():
            if name in counted:
                counted[name].add_metric([camera.name], count)
            else:
                by_cause = lost if name in LOST_CAUSES else refused if name in _DROPPED_CAUSES else others
                by_cause.add_metric([camera.name, name], count)
        for cause, count in camera.dropped.items():
            dropped.add_metric([camera.name, cause], count)
    yield from (connected, *counted.values(), lost, dropped, refused, others)


def _clocks(cameras: Iterable[CameraMetrics]) -> Iterator[Metric]:
    offset = _gauge("rig_clock_offset_seconds", "Rig clock minus agent clock.", "camera")
    drift = _gauge("rig_clock_drift_ratio", "Change of the offset, in seconds a second.", "camera")
    error = _gauge("rig_clock_uncertainty_seconds", "Standard uncertainty of the offset.", "camera")
    trip = _gauge("rig_clock_round_trip_seconds", "Shortest round trip of the clock exchange.", "camera")
    system = _gauge(
        "rig_clock_by_system_time",
        "1 while both machines' disciplined clocks tell the offset.",
        "camera",
    )
    for camera in cameras:
        if (clock := camera.clock) is not None:
            system.add_metric([camera.name], clock.source == "system")
            offset.add_metric([camera.name], clock.offset_ns / 1e9)
            drift.add_metric([camera.name], clock.drift_ppm / 1e6)
            error.add_metric([camera.name], clock.uncertainty_ns / 1e9)
            trip.add_metric([camera.name], clock.delay_ns / 1e9)
    yield from (offset, drift, error, trip, system)


def _agents(cameras: Iterable[CameraMetrics]) -> Iterator[Metric]:
    temperature = _gauge("rig_agent_temperature_celsius", "Processor temperature of the agent.", "camera")
    others = _gauge("rig_agent_gauge", "What else an agent tells of itself.", "camera", "gauge")
    for camera in cameras:
        if camera.temperature_c is not None:
            temperature.add_metric([camera.name], camera.temperature_c)
        for name, value in _told_gauges(camera.gauges).items():
            others.add_metric([camera.name, name], value)
    yield from (temperature, others)


def _sets(status: RigStatus) -> Iterator[Metric]:
    went_out = _counter("rig_sets", "Sets that went out.", "outcome")
    went_out.add_metric(["complete"], status.complete)
    went_out.add_metric(["partial"], status.partial)
    repeated = _counter("rig_frames_repeated", "Frames that went out once more (policy latest).")
    repeated.add_metric([], status.repeated)
    spread = _histogram("rig_set_spread_seconds", "Latest exposure of a set minus its earliest.")
    error = _histogram("rig_set_uncertainty_seconds", "Largest standard uncertainty of a set's frame times.")
    stages = _histogram("rig_stage_latency_seconds", "How long each stage of the way takes.", "stage")
    for family, name, labels in (
        (spread, SPREAD, []),
        (error, UNCERTAINTY, []),
        *((stages, stage, [stage]) for stage in STAGES),
    ):
        if name in status.durations:
            _add_histogram(family, labels, status.durations[name])
    yield from (went_out, repeated, spread, error, stages)


def _rig(status: RigStatus) -> Iterator[Metric]:
    for name, about in DROPPED.items():
        dropped = _counter(*about)
        dropped.add_metric([], status.dropped.get(name, 0))
        yield dropped
    rejected = _counter("rig_datagrams_rejected", "Datagrams that belong to no camera.", "cause")
    for cause, count in status.rejected.items():
        rejected.add_metric([cause], count)
    yield rejected
    queues = _gauge("rig_queue_length", "Frames (decoder, synchroniser) or sets that wait.", "queue")
    for name, length in status.queues.items():
        queues.add_metric([name], length)
    yield queues
    yield GaugeMetricFamily(
        "rig_receive_buffer_bytes", "How much of the kernel's receive buffer is taken.", status.unread_bytes
    )


def _recording(recording: RecordingStatus | None) -> Iterator[Metric]:
    active = _gauge("rig_recording_active", "1 while a take is being recorded.")
    frames = _counter("rig_recorded_frames", "Frames that were recorded.")
    size = _counter("rig_recorded_bytes", "Bytes that were recorded.")
    dropped = _counter("rig_frames_not_recorded", "Frames that the disk was too slow for.")
    waiting = _gauge("rig_recording_queue_bytes", "What waits for the disk.")
    if recording is not None:
        active.add_metric([], recording.ended is None)
        frames.add_metric([], recording.frames)
        size.add_metric([], recording.bytes)
        dropped.add_metric([], recording.dropped)
        waiting.add_metric([], recording.waiting_bytes)
    yield from (active, frames, size, dropped, waiting)


def _drift(drift: DriftReport | None) -> Iterator[Metric]:
    moved = _gauge("rig_camera_moved", "1 when the camera is not where its calibration says.", "camera")
    shift_mm = _gauge("rig_camera_shift_mm", "By how many millimetres it moved.", "camera")
    shift_deg = _gauge("rig_camera_shift_deg", "By how many degrees it turned.", "camera")
    judged = _gauge("rig_camera_watched", "1 while the drift watch can tell where the camera is.", "camera")
    apart = _gauge("rig_overlap_residual_mm", "How far apart two cameras see one place.", "camera", "other")
    looks = _counter(
        "rig_drift_looks", "Sets that the drift watch looked at, and that found it busy.", "outcome"
    )
    if drift is not None:
        names = drift.names
        for one in drift.status.cameras:
            labels = [names.get(one.camera, str(one.camera))]
            moved.add_metric(labels, one.state == "moved")
            shift_mm.add_metric(labels, one.mm)
            shift_deg.add_metric(labels, one.deg)
            judged.add_metric(labels, one.camera in drift.status.judged)
        for pair in drift.status.pairs:
            if pair.mm is not None:
                apart.add_metric([names.get(k, str(k)) for k in (pair.i, pair.j)], pair.mm)
        looks.add_metric(["looked"], drift.status.looks)
        looks.add_metric(["busy"], drift.passed_over)
    yield from (moved, shift_mm, shift_deg, judged, apart, looks)


def _told_gauges(gauges: Mapping[str, float]) -> dict[str, float]:
    """The gauges without a metric of their own, under names fit for a label, bounded in number."""
    told: dict[str, float] = {}
    for name, value in sorted(gauges.items()):
        if name != TEMPERATURE and len(told) < _MAX_GAUGES:
            told.setdefault(re.sub(r"[^a-zA-Z0-9_]", "_", name[:_MAX_GAUGE_NAME]), value)
    return told


def _counter(name: str, about: str, *labels: str) -> CounterMetricFamily:
    return CounterMetricFamily(name, about, labels=labels)


def _gauge(name: str, about: str, *labels: str) -> GaugeMetricFamily:
    return GaugeMetricFamily(name, about, labels=labels)


def _histogram(name: str, about: str, *labels: str) -> HistogramMetricFamily:
    return HistogramMetricFamily(name, about, labels=labels)


def _add_histogram(family: HistogramMetricFamily, labels: list[str], seen: HistogramSnapshot) -> None:
    """Prometheus wants the counts up to each bound, in seconds."""
    below, buckets = 0, []
    for bound, count in zip([*(f"{ns / 1e9:g}" for ns in seen.bounds_ns), "+Inf"], seen.counts, strict=True):
        below += count
        buckets.append((bound, float(below)))
    family.add_metric(labels, buckets, seen.sum_ns / 1e9)
