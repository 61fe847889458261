"""A Kinect's clock against this machine's: device ticks become agent time."""

import math
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

TICK_HZ = 60_000_000
_WRAP = 1 << 32  # ticks are a uint32: 71.58 s
_BLOCK_NS = 1_000_000_000
# A minute shows the rate to a few ppm, and a crystal's own wander in that time is small.
_BLOCKS = 60
# The slope of so few seconds is as doubtful as the drift of any two crystals.
_SLOPE_SPAN_S = 2.0
# One isochronous transfer holds 16 microframes of 125 µs: a frame arrives up to this late, evenly spread.
_TRANSFER_NS = 2_000_000
# A device at exactly 30 Hz meets the bus' grid of transfers in three phases only; where the crystals agree to
# a few ppm, the least of them stays for minutes, and cannot be told from none: it is anything up to a third
# of a transfer, evenly.
_PHASE_NS = _TRANSFER_NS / 3 / math.sqrt(12)
_DRIFT = 200e-6  # quartz clocks are off by less than 100 ppm each
# libfreenect holds 32 ms of packets: what is later than this thrice running is no queue, the device's
# clock fell back or this machine slept.
_LATE_NS = 100_000_000
_LATE_FRAMES = 3
_FRAMES_A_BLOCK = 30


def tick_difference(later: int, earlier: int) -> int:
    """Ticks from `earlier` to `later`, signed, across the counter's wrap."""
    return (later - earlier + _WRAP // 2) % _WRAP - _WRAP // 2


class _Lag(NamedTuple):
    """Arrival minus device time, at a device time."""

    device_ns: int
    lag_ns: int


class _Envelope:
    """The line under the lags of the last minute: what a frame without any delay would have.

    Of all lines below every lag, the one closest to them in sum: the edge of their lower convex hull over
    their mean time (Moon, Skelly and Towsley, INFOCOM 1999; Zhang, Liu and Xia, INFOCOM 2002). Delays
    only add, and however long one is, it moves nothing. Of each second only the least lag is kept.
    """

    def __init__(self, first: _Lag, slope: float) -> None:
        """The slope is the best guess so far, and counts while the seconds are few."""
        self.slope, self._first_slope = slope, slope
        self._frames = 1
        self._scatter_ns = 0.0  # of the seconds' least lags above the line
        self._least: deque[_Lag] = deque([first], maxlen=_BLOCKS)
        self._block = first.device_ns // _BLOCK_NS
        self._anchor = first

    def at(self, device_ns: int) -> int:
        """Least lag at a device time."""
        return self._anchor.lag_ns + round(self.slope * (device_ns - self._anchor.device_ns))

    def add(self, lag: _Lag) -> None:
        """Take a frame's lag."""
        self._frames += 1
        block = lag.device_ns // _BLOCK_NS
        if block != self._block:
            self._block = block
            self._fit()
            self._least.append(lag)
            while lag.device_ns - self._least[0].device_ns > _BLOCKS * _BLOCK_NS:
                self._least.popleft()
        elif lag.lag_ns < self._least[-1].lag_ns:
            self._least[-1] = lag
        if lag.lag_ns < self.at(lag.device_ns):
            self._fit()

    def doubt_ns(self, device_ns: int, range_ns: float) -> float:
        """Standard uncertainty of the line at a device time, where delays spread over this range.

        A second's least lag is expected range / (n + 1) above the line. The line is known by as many
        seconds as it has, and at worst as they scatter about it; its slope by that over their span.
        """
        seconds = len(self._least)
        height_ns = range_ns / (min(self._frames, _FRAMES_A_BLOCK) + 1)
        value_ns = math.hypot(2 * height_ns / math.sqrt(seconds), self._scatter_ns)
        span_ns = self._least[-1].device_ns - self._least[0].device_ns
        slope = min(_DRIFT, 2 * value_ns / span_ns) if span_ns >= _BLOCK_NS else _DRIFT
        return value_ns + slope * (device_ns - self._least[-1].device_ns)

    def _fit(self) -> None:
        points = self._least
        span_s = (points[-1].device_ns - points[0].device_ns) / 1e9
        seen = max(-_DRIFT, min(_DRIFT, _slope_below(points)))
        slope = self._first_slope + (seen - self._first_slope) * span_s**2 / (span_s**2 + _SLOPE_SPAN_S**2)
        origin_ns = points[-1].device_ns
        heights = [point.lag_ns - slope * (point.device_ns - origin_ns) for point in points]
        lowest = min(range(len(points)), key=heights.__getitem__)
        self._anchor, self.slope = points[lowest], slope
        # The median, because a second in which the host stood still says nothing of the others.
        self._scatter_ns = sorted(heights)[len(heights) // 2] - heights[lowest]


class DeviceClock:
    """Unwraps ticks and maps them to agent time by the least delays of the last minute.

    Stamps are never later than the arrival, rise with every frame, and err by the least delay (below a
    millisecond, the same for all frames) besides what `stamp` states.
    """

    def __init__(self) -> None:
        """Start with no idea of the offset."""
        self._envelope: _Envelope | None = None
        self._last_total = 0
        self._last_arrival_ns = 0
        self._last_stamp_ns = 0
        self._late_frames = 0
        self._excess_ns = _TRANSFER_NS / 2

    def stamp(self, ticks: int, arrival_ns: int) -> tuple[int, int]:
        """Agent time of this tick count, and its standard uncertainty, both in ns."""
        total, went_back = self._unwrap(ticks, arrival_ns)
        device_ns = total * 1_000_000_000 // TICK_HZ
        lag = _Lag(device_ns, arrival_ns - device_ns)
        envelope = self._envelope
        if envelope is None or went_back or self._jumped(envelope, lag, arrival_ns):
            envelope = self._envelope = _Envelope(lag, envelope.slope if envelope else 0.0)
            self._late_frames = 0
        else:
            envelope.add(lag)
        stamp_ns = min(device_ns + envelope.at(device_ns), arrival_ns)
        excess_ns = arrival_ns - stamp_ns
        self._excess_ns += (min(excess_ns, _LATE_NS) - self._excess_ns) / _FRAMES_A_BLOCK
        rising_ns = max(stamp_ns, self._last_stamp_ns + 1) if self._last_arrival_ns else stamp_ns
        self._last_arrival_ns, self._last_stamp_ns = arrival_ns, rising_ns
        return rising_ns, self._uncertainty(envelope, device_ns, excess_ns) + rising_ns - stamp_ns

    def _unwrap(self, ticks: int, arrival_ns: int) -> tuple[int, bool]:
        """Ticks since the first wrap, however long nothing arrived; True when the counter was reset."""
        total, went_back = ticks, False
        if self._envelope is not None:
            expected = self._last_total + (arrival_ns - self._last_arrival_ns) * TICK_HZ // 1_000_000_000
            total = expected + tick_difference(ticks, expected)
            went_back = total < self._last_total
        self._last_total = total
        return total, went_back

    def _jumped(self, envelope: _Envelope, lag: _Lag, arrival_ns: int) -> bool:
        """True when the clocks moved against each other: a lag far below the line, or long far above."""
        above_ns = lag.lag_ns - envelope.at(lag.device_ns)
        silence_ns = arrival_ns - self._last_arrival_ns
        self._late_frames = self._late_frames + 1 if above_ns > _LATE_NS else 0
        return (
            above_ns < -_TRANSFER_NS - _DRIFT * silence_ns
            or self._late_frames >= _LATE_FRAMES
            or silence_ns > _BLOCKS * _BLOCK_NS
        )

    def _uncertainty(self, envelope: _Envelope, device_ns: int, excess_ns: int) -> int:
        range_ns = max(_TRANSFER_NS, 2 * self._excess_ns)
        late_ns = excess_ns if excess_ns > _LATE_NS else 0
        return math.ceil(math.hypot(envelope.doubt_ns(device_ns, range_ns), _PHASE_NS)) + late_ns


def _slope_below(points: Sequence[_Lag]) -> float:
    """Slope of the lower convex hull's edge over the points' mean time; 0 for a single point."""
    hull: list[_Lag] = []
    for point in points:
        while len(hull) > 1 and _slope(hull[-2], hull[-1]) >= _slope(hull[-1], point):
            hull.pop()
        hull.append(point)
    mean_ns = sum(point.device_ns for point in points) / len(points)
    return next((_slope(a, b) for a, b in pairwise(hull) if b.device_ns >= mean_ns), 0.0)


def _slope(earlier: _Lag, later: _Lag) -> float:
    return (later.lag_ns - earlier.lag_ns) / (later.device_ns - earlier.device_ns)
