"""Timestamps of OpenNI2: the unit that a driver counts in, and when a recorded frame is due."""

from collections.abc import Callable

from rig_agent.sources.device_clock import TICK_HZ, tick_difference

_TICKS_PER_US = TICK_HZ // 1_000_000
_COUNTER = 1 << 32  # FreenectDriver hands on a uint32
_TOLERANCE = 1.25  # of a step against the nominal rate; a Kinect's is exact
_UNDECIDED_LIMIT = 8  # steps


class TimestampUnit:
    """Whether a driver counts microseconds, as OpenNI2 documents, or the Kinect's 60-MHz ticks.

    FreenectDriver of libfreenect 0.5.3 hands on raw ticks. The first step between two images of a stream
    tells: the units lie a factor of 60 apart. Steps that fit neither, as in a recording with gaps, are
    microseconds.
    """

    def __init__(self, fps: float) -> None:
        """`fps` is the streams' nominal rate."""
        self._interval_us = 1e6 / fps
        self._ticks_per_unit: int | None = None
        self._last: dict[str, tuple[int, int]] = {}
        self._undecided = 0

    @property
    def is_known(self) -> bool:
        """True from the first step on."""
        return self._ticks_per_unit is not None

    @property
    def name(self) -> str:
        """For the log."""
        return {None: "unknown units", 1: "60-MHz ticks"}.get(self._ticks_per_unit, "microseconds")

    def ticks(self, stream: str, timestamp: int, index: int) -> int | None:
        """The timestamp in 32-bit ticks of 60 MHz; None while the unit is unknown.

        `index` counts the frames of the stream, those that nobody fetched included.
        """
        if self._ticks_per_unit is None:
            self._decide(stream, timestamp, index)
        if self._ticks_per_unit is None:
            return None
        return timestamp * self._ticks_per_unit % _COUNTER

    def _decide(self, stream: str, timestamp: int, index: int) -> None:
        last, self._last[stream] = self._last.get(stream), (timestamp, index)
        if last is None:
            return
        frames = max(index - last[1], 1)
        ratio = (timestamp - last[0]) % _COUNTER / (frames * self._interval_us)
        self._undecided += 1
        if 1 / _TOLERANCE < ratio / _TICKS_PER_US < _TOLERANCE:
            self._ticks_per_unit = 1
        elif 1 / _TOLERANCE < ratio < _TOLERANCE or self._undecided == _UNDECIDED_LIMIT:
            self._ticks_per_unit = _TICKS_PER_US


class PlaybackClock:
    """When each frame of a recording is due, in real time; the recording starts anew at its end."""

    _LONGEST_GAP_TICKS = TICK_HZ  # what is longer, or goes back, is a cut: one frame interval
    _LATEST_NS = 100_000_000  # a reader that was away longer goes on from now instead of catching up

    def __init__(self, fps: float, clock: Callable[[], int]) -> None:
        """`clock` tells agent time."""
        self._interval_ns = round(1e9 / fps)
        self._clock = clock
        self._last: tuple[int, int] | None = None

    def due_ns(self, ticks: int) -> int:
        """Agent time at which the frame with this stamp is due, one frame after the other."""
        now_ns = self._clock()
        if self._last is None:
            due_ns = now_ns
        else:
            step = tick_difference(ticks, self._last[0])
            usual = 0 < step <= self._LONGEST_GAP_TICKS
            step_ns = step * 1_000_000_000 // TICK_HZ if usual else self._interval_ns
            due_ns = self._last[1] + step_ns
            if due_ns < now_ns - self._LATEST_NS:
                due_ns = now_ns
        self._last = ticks, due_ns
        return due_ns
