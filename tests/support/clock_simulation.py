"""A clock exchange in virtual time: two clocks that differ, a path that delays, loses and spikes."""

import heapq
import math
import random
from dataclasses import dataclass, field
from typing import NamedTuple

from rig_protocol.clock_sync import ClockSync
from rig_protocol.messages import ClockReply, ClockRequest

START_NS = 10**12
_IN_AGENT_NS = 100_000
_FRAME_INTERVAL_NS = 33_333_333
_FRAME_AGE_NS = 20_000_000  # from its stamp to its last datagram at the server


@dataclass(slots=True)
class WanderingClock:
    """An agent's clock whose drift swings about a mean, as with the temperature of its crystal."""

    offset_ns: int = -(3 * 10**14)
    drift_ppm: float = 0.0
    swing_ppm: float = 0.0
    period_s: float = 300.0

    def read(self, rig_ns: int) -> int:
        """Agent time at a rig time."""
        elapsed_ns = rig_ns - START_NS
        turn = 2 * math.pi / self.period_s
        swung_ns = self.swing_ppm * 1e3 * (1 - math.cos(turn * elapsed_ns / 1e9)) / turn
        return rig_ns + self.offset_ns + round(elapsed_ns * self.drift_ppm * 1e-6 + swung_ns)


@dataclass(frozen=True, slots=True)
class Way:
    """One direction of the path: a least delay, exponential jitter, spikes, loss."""

    least_ns: int = 150_000
    jitter_ns: int = 1_000_000
    spike_ns: int = 20_000_000
    spikes: float = 0.01
    loss: float = 0.05

    def delay_ns(self, random_source: random.Random) -> int | None:
        """The delay of one message; None when it is lost."""
        if random_source.random() < self.loss:
            return None
        spike_ns = self.spike_ns if random_source.random() < self.spikes else 0
        jitter_ns = round(random_source.expovariate(1 / self.jitter_ns)) if self.jitter_ns else 0
        return self.least_ns + spike_ns + jitter_ns


class FrameTime(NamedTuple):
    """A frame as the server dates it."""

    true_ns: int
    mapped_ns: int
    uncertainty_ns: int

    @property
    def error_ns(self) -> int:
        """How late it is dated."""
        return self.mapped_ns - self.true_ns


@dataclass
class ClockSimulation:
    """A ClockSync that asks over the path, and frames at 30 Hz that it dates as they arrive."""

    clock: WanderingClock
    forth: Way = Way()
    back: Way = Way()
    seed: int = 0
    now_ns: int = START_NS
    frames: list[FrameTime] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.sync = ClockSync(self.now_ns)
        self._random = random.Random(self.seed)
        self._arrivals: list[tuple[int, ClockReply]] = []
        self._waiting: list[tuple[int, int, int]] = []
        self._next_frame_ns = self.now_ns

    def run(self, seconds: float) -> "ClockSimulation":
        """Let so much time pass."""
        end_ns = self.now_ns + round(seconds * 1e9)
        while (next_ns := self._next_ns()) <= end_ns:
            self.now_ns = max(self.now_ns, next_ns)
            if self.sync.next_request_ns <= self.now_ns:
                self._send(self.sync.request(self.now_ns))
            while self._arrivals and self._arrivals[0][0] <= self.now_ns:
                self.sync.receive(heapq.heappop(self._arrivals)[1], self.now_ns)
            self._handle_frames()
        self.now_ns = end_ns
        return self

    def _next_ns(self) -> int:
        times = [self.sync.next_request_ns, self._next_frame_ns]
        times += [self._arrivals[0][0]] if self._arrivals else []
        times += [self._waiting[0][0]] if self._waiting else []
        return min(times)

    def _send(self, request: ClockRequest) -> None:
        forth_ns = self.forth.delay_ns(self._random)
        back_ns = self.back.delay_ns(self._random)
        if forth_ns is None or back_ns is None:
            return
        asked_ns = self.now_ns + forth_ns
        replied_ns = asked_ns + _IN_AGENT_NS
        reply = ClockReply(request.t1_ns, self.clock.read(asked_ns), self.clock.read(replied_ns))
        heapq.heappush(self._arrivals, (replied_ns + back_ns, reply))

    def _handle_frames(self) -> None:
        if self._next_frame_ns <= self.now_ns:
            stamp = (self.now_ns + _FRAME_AGE_NS, self.now_ns, self.clock.read(self.now_ns))
            self._waiting.append(stamp)
            self._next_frame_ns += _FRAME_INTERVAL_NS
        if self._waiting and self._waiting[0][0] <= self.now_ns:
            _, true_ns, agent_ns = self._waiting.pop(0)
            mapped = self.sync.to_rig(agent_ns)
            if mapped is not None:
                self.frames.append(FrameTime(true_ns, *mapped))
