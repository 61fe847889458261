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
# One isochronous transfer holds 16 microframes of 125 µs: a frame arrives up to this late, evenly spread.
_TRANSFER_NS = 2_000_000
_DRIFT = 200e-6  # quartz clocks are off by less than 100 ppm each
# libfreenect holds 32 ms of packets: what is later than this thrice running is no queue, the device's
# clock fell back or this machine slept.
_LATE_NS = 100_000_000
_LATE_FRAMES = 3
_EXCESS_FRAMES = 30  # over which the usual delay is averaged


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

    def __init__(self, first: _Lag) -> None:
        self.frames = 1
        self._scatter_ns = 0.0  # of the seconds' least lags above the line
        self._least: deque[_Lag] = deque([first], maxlen=_BLOCKS)
        self._block = first.device_ns // _BLOCK_NS
        self._anchor, self._slope = first, 0.0

    def at(self, device_ns: int) -> int:
        """Least lag at a device time."""
        return self._anchor.lag_ns + round(self._slope * (device_ns - self._anchor.device_ns))

    def add(self, lag: _Lag) -> None:
        """Take a frame's lag."""
        self.frames += 1
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

    def doubt_ns(self, device_ns: int) -> float:
        """How far the line may be off: the seconds scatter about it, and its slope is known by that."""
        span_ns = self._least[-1].device_ns - self._least[0].device_ns
        slope_doubt = min(_DRIFT, 2 * self._scatter_ns / span_ns) if span_ns >= _BLOCK_NS else _DRIFT
        return self._scatter_ns + slope_doubt * (device_ns - self._least[-1].device_ns)

    def _fit(self) -> None:
        points = self._least
        slope = max(-_DRIFT, min(_DRIFT, _slope_below(points)))
        origin_ns = points[-1].device_ns
        heights = [point.lag_ns - slope * (point.device_ns - origin_ns) for point in points]
        lowest = min(range(len(points)), key=heights.__getitem__)
        self._anchor, self._slope = points[lowest], slope
        self._scatter_ns = sum(heights) / len(heights) - heights[lowest]


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
            envelope = self._envelope = _Envelope(lag)
            self._late_frames = 0
        else:
            envelope.add(lag)
        stamp_ns = device_ns + envelope.at(device_ns)
        excess_ns = arrival_ns - stamp_ns
        self._excess_ns += (min(excess_ns, _LATE_NS) - self._excess_ns) / _EXCESS_FRAMES
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
        # The least of n evenly spread delays is expected at 1/(n+1) of their range, twice their mean.
        range_ns = max(_TRANSFER_NS, 2 * self._excess_ns)
        late_ns = excess_ns if excess_ns > _LATE_NS else 0
        return math.ceil(range_ns / (envelope.frames + 1) + envelope.doubt_ns(device_ns)) + late_ns


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
