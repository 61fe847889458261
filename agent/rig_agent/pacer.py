"""Spreads each frame's datagrams over most of the frame interval, in small bursts.

Twelve agents that each send a frame at once overflow the switch port of the server (incast). Where the
server has a plan, bursts leave on its grid, where each agent has a place of its own. No clock here: the
caller gives the time and sends what `next_burst` and `next_resend` return.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from rig_protocol.datagram import DatagramBatch

F = TypeVar("F")

# A sender that the machine held up sends this many bursts at once, at twice their rate, until it is in time.
_CATCH_UP = 4
# A frame still unsent after this many intervals is given up for a newer one: the server gave it up, too.
_STALE_INTERVALS = 2
# Answers to requests: the budget of the link holds three frames, in at most as many pieces as a frame has.
_MAX_RESENDS = 512


@dataclass(frozen=True, slots=True)
class BurstGrid:
    """Moments at which bursts leave: agent times that are `phase_ns` modulo `step_ns`; see SPEC, PLAN.

    `spread`: share of the frame interval to send a frame over.
    """

    step_ns: int
    phase_ns: int
    spread: float

    def next_ns(self, now_ns: int) -> int:
        """The first moment from `now_ns` on."""
        return now_ns + (self.phase_ns - now_ns) % self.step_ns


@dataclass(slots=True)
class PacerCounters:
    """Frames sent whole, and frames dropped because a newer one was ready before they were sent."""

    sent: int = 0
    dropped: int = 0


class Pacer(Generic[F]):
    """Holds at most two frames, the one that is being sent and the newest one after it, and resends.

    A frame is cut into datagrams when its turn has come: one that gives way to a newer one has no number
    then, and nobody misses it.
    """

    def __init__(
        self, interval_ns: int, spread: float, burst: int, cut: Callable[[F, int], DatagramBatch | None]
    ) -> None:
        """`spread` is the share of the frame interval to send over, `burst` the datagrams sent at once.

        `cut` gives the datagrams of a frame at an agent time, or None where nobody listens any more.
        """
        self._cut = cut
        self.interval_ns = interval_ns
        self.grid: BurstGrid | None = None
        self.counters = PacerCounters()
        self._spread = spread
        self._default_burst = self._burst = burst
        self._current: DatagramBatch | None = None
        self._waiting: F | None = None
        self._position = 0
        self._started_ns = 0
        self._step_ns = 0
        self._steps = 1
        self._due_ns = 0
        self._resends: deque[DatagramBatch] = deque(maxlen=_MAX_RESENDS)
        self._resend_due_ns = 0

    def submit(self, frame: F, now_ns: int) -> DatagramBatch | None:
        """Take a frame to send; one that waited gives way. The datagrams of one under way that must, too."""
        if self._current is None:
            self._start(frame, now_ns)
            return None
        self.counters.dropped += self._waiting is not None
        self._waiting = frame
        age_ns = now_ns - self._started_ns
        if -self.interval_ns <= age_ns <= _STALE_INTERVALS * self.interval_ns:
            return None
        # It is stale, or the clock has jumped.
        given_up = self._current
        self.counters.dropped += 1
        self._advance(now_ns)
        return given_up

    def sent_of(self, batch: DatagramBatch) -> int:
        """How many datagrams of a frame have left so far."""
        return self._position if batch is self._current else len(batch)

    def next_burst(self, now_ns: int) -> DatagramBatch | None:
        """The datagrams that are due, or None; tell `sent` how many of them went out."""
        if self._current is None or now_ns < self._due_ns:
            return None
        due = self._due_after(1 + (now_ns - self._started_ns) // self._step_ns)
        stop = min(max(due, self._position + 1), self._position + _CATCH_UP * self._burst)
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
        step = self._position * self._steps // len(self._current)  # the first at which more is due
        planned_ns = self._started_ns + step * self._step_ns
        self._due_ns = max(planned_ns, now_ns + self._step_ns // 2)

    def resend(self, batch: DatagramBatch) -> None:
        """Take datagrams to send again, ahead of the frame's own; the oldest of too many are dropped."""
        self._resends.append(batch)

    def next_resend(self, now_ns: int) -> DatagramBatch | None:
        """Datagrams to send again now, at most one burst a step, or None."""
        if not self._resends or 0 < self._resend_due_ns - now_ns <= self.interval_ns:
            return None
        batch = self._resends.popleft()
        if len(batch) > self._burst:
            rest = DatagramBatch(batch.part(self._burst, len(batch)), batch.segment_size)
            self._resends.appendleft(rest)
            batch = DatagramBatch(batch.part(0, self._burst), batch.segment_size)
        self._resend_due_ns = now_ns + self._step_ns * len(batch) // self._burst
        return batch

    def next_timeout_ns(self) -> int | None:
        """When the next burst is due; None when there is nothing to send."""
        dues = [] if self._current is None else [self._due_ns]
        if self._resends:
            dues.append(self._resend_due_ns)
        return min(dues, default=None)

    def clear(self) -> None:
        """Drop what is unsent, because nobody listens any more."""
        self.counters.dropped += (self._current is not None) + (self._waiting is not None)
        self._current = self._waiting = None
        self._resends.clear()

    def _due_after(self, steps: int) -> int:
        """How many datagrams of the frame are to have left after so many steps."""
        return 0 if self._current is None else -(-steps * len(self._current) // self._steps)

    def _advance(self, now_ns: int) -> None:
        following, self._waiting, self._current = self._waiting, None, None
        if following is not None:
            self._start(following, now_ns)

    def _start(self, frame: F, now_ns: int) -> None:
        batch = self._cut(frame, now_ns)
        if batch is None:
            return
        self._current, self._position = batch, 0
        if self.grid is not None and self._spread > 0:
            self._steps = max(1, int(self.interval_ns * self.grid.spread / self.grid.step_ns))
            self._step_ns = self.grid.step_ns
            self._started_ns = self._due_ns = self.grid.next_ns(now_ns)
        else:
            self._steps = max(1, -(-len(batch) // self._default_burst))
            self._step_ns = max(1, round(self.interval_ns * self._spread / self._steps))
            self._started_ns = self._due_ns = now_ns
        self._burst = -(-len(batch) // self._steps)
