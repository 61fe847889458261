"""Spreads each frame's datagrams over most of the frame interval, in small bursts.

Twelve agents that each send a frame at once overflow the switch port of the server (incast). No clock
here: the caller gives the time and sends what `next_burst` returns.
"""

from dataclasses import dataclass

from rig_protocol.datagram import DatagramBatch

# A sender that the machine held up sends this many bursts at once, at twice their rate, until it is in time.
_CATCH_UP = 4
# A frame still unsent after this many intervals is given up for a newer one: the server gave it up, too.
_STALE_INTERVALS = 2


@dataclass(slots=True)
class PacerCounters:
    """Frames sent whole, and frames dropped because a newer one was ready before they were sent."""

    sent: int = 0
    dropped: int = 0


class Pacer:
    """Holds at most two frames: the one that is being sent and the newest one after it."""

    def __init__(self, interval_ns: int, spread: float, burst: int) -> None:
        """`spread` is the share of the frame interval to send over, `burst` the datagrams sent at once."""
        self.interval_ns = interval_ns
        self._spread = spread
        self._burst = burst
        self._current: DatagramBatch | None = None
        self._waiting: DatagramBatch | None = None
        self._position = 0
        self._started_ns = 0
        self._step_ns = 0
        self._due_ns = 0
        self.counters = PacerCounters()

    def submit(self, batch: DatagramBatch, now_ns: int) -> None:
        """Take a frame to send; an older one that has not begun, or has become stale, is dropped."""
        if self._current is None:
            self._start(batch, now_ns)
            return
        if self._waiting is not None:
            self.counters.dropped += 1
        self._waiting = batch
        stale = now_ns - self._started_ns > _STALE_INTERVALS * self.interval_ns
        if self._position == 0 or stale:
            self.counters.dropped += 1
            self._advance(now_ns)

    def next_burst(self, now_ns: int) -> DatagramBatch | None:
        """The datagrams that are due, or None; tell `sent` how many of them went out."""
        if self._current is None or now_ns < self._due_ns:
            return None
        bursts_due = 1 + (now_ns - self._started_ns) // self._step_ns
        stop = min(bursts_due * self._burst, self._position + _CATCH_UP * self._burst)
        return DatagramBatch(self._current.part(self._position, stop), self._current.segment_size)

    def sent(self, count: int, now_ns: int) -> None:
        """The network took the first `count` datagrams of the burst; the others stay due."""
        if self._current is None:
            return
        self._position += count
        if self._position >= len(self._current):
            self.counters.sent += 1
            self._advance(now_ns)
            return
        planned_ns = self._started_ns + self._position // self._burst * self._step_ns
        self._due_ns = max(planned_ns, now_ns + self._step_ns // 2)

    def next_timeout_ns(self) -> int | None:
        """When the next burst is due; None when there is nothing to send."""
        return None if self._current is None else self._due_ns

    def clear(self) -> None:
        """Drop what is unsent, because nobody listens any more."""
        self.counters.dropped += (self._current is not None) + (self._waiting is not None)
        self._current = self._waiting = None

    def _advance(self, now_ns: int) -> None:
        following, self._waiting, self._current = self._waiting, None, None
        if following is not None:
            self._start(following, now_ns)

    def _start(self, batch: DatagramBatch, now_ns: int) -> None:
        bursts = max(1, -(-len(batch) // self._burst))
        self._current, self._position = batch, 0
        self._started_ns = self._due_ns = now_ns
        self._step_ns = max(1, round(self.interval_ns * self._spread / bursts))
