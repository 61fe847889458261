"""What is timed: the stages of a frame's way, and how far apart and how uncertain the times of a set are."""

from collections.abc import Mapping

from rig_protocol.frames import RgbdFrame
from rig_server.assembler import SetRecord
from rig_server.histogram import Histogram, HistogramSnapshot
from rig_server.sample_window import SampleWindow

EXPOSURE_TO_RECEIVED = "exposure_to_received"
"""From the exposure until the frame's last datagram was here: camera, agent and network."""
RECEIVED_TO_DECODED = "received_to_decoded"
"""From then until both images were decoded: waiting for a decoder thread, and decoding."""
RECEIVED_TO_DELIVERED = "received_to_delivered"
"""From the last datagram of a set's last frame until the set could be taken."""
SPREAD = "spread"
"""Latest exposure of a set minus its earliest."""
UNCERTAINTY = "uncertainty"
"""The largest standard uncertainty among the times of a set's frames."""
STAGES = (EXPOSURE_TO_RECEIVED, RECEIVED_TO_DECODED, RECEIVED_TO_DELIVERED)

_MS = 1_000_000
# 20 ms: what delivery is judged by. 10 s: the link accepts no older frame.
_LATENCY_MS = (0.5, 1, 2, 3, 5, 7.5, 10, 15, 20, 30, 50, 75, 100, 150, 200, 300, 500, 1000, 2000, 5000, 1e4)
_SPREAD_MS = (1, 2, 5, 10, 15, 20, 25, 30, 35, 40, 50, 75, 100, 200, 500, 1000)
_UNCERTAINTY_MS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100)

# Long enough for a p99 at 30 sets a second, short enough to show what just went wrong.
_RECENT_NS = 30_000_000_000
_RECENT_SPACING_NS = 1_000_000_000


class Durations:
    """One histogram each; any thread may count."""

    def __init__(self) -> None:
        bounds_ms = dict.fromkeys(STAGES, _LATENCY_MS) | {SPREAD: _SPREAD_MS, UNCERTAINTY: _UNCERTAINTY_MS}
        self._histograms = {
            name: Histogram([round(bound * _MS) for bound in bounds]) for name, bounds in bounds_ms.items()
        }

    def frame_decoded(self, frame: RgbdFrame, now_ns: int) -> None:
        """Count the stages of a frame that was decoded just now; one that crossed no network has none."""
        if frame.received_ns is not None:
            self._histograms[EXPOSURE_TO_RECEIVED].observe(frame.received_ns - frame.timestamp_ns)
            self._histograms[RECEIVED_TO_DECODED].observe(now_ns - frame.received_ns)

    def set_delivered(self, record: SetRecord) -> None:
        """Count a set that may be taken from now on."""
        self._histograms[SPREAD].observe(record.spread_ns)
        self._histograms[UNCERTAINTY].observe(record.uncertainty_ns)
        if record.received_ns is not None:
            self._histograms[RECEIVED_TO_DELIVERED].observe(record.delivered_ns - record.received_ns)

    def snapshot(self) -> dict[str, HistogramSnapshot]:
        """All histograms by name."""
        return {name: histogram.snapshot() for name, histogram in self._histograms.items()}


class RecentDurations:
    """The durations of the last half minute, by what the histograms held before. Not for several threads."""

    def __init__(self) -> None:
        self._window = SampleWindow[Mapping[str, HistogramSnapshot]](_RECENT_NS, _RECENT_SPACING_NS)

    def update(self, total: Mapping[str, HistogramSnapshot], now_ns: int) -> dict[str, HistogramSnapshot]:
        """What came since the oldest sample of the window; all of `total` the first time."""
        samples = self._window.add(total, now_ns)
        if len(samples) == 1:
            return dict(total)
        _, earlier = samples[0]
        return {name: histogram.since(earlier[name]) for name, histogram in total.items()}
