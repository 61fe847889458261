"""Agent time to rig time: the server's side of the clock exchange (protocol/SPEC.md, section 8)."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Literal, NamedTuple

from rig_protocol.messages import ClockReply, ClockRequest
from rig_protocol.offset_filter import OffsetFilter, OffsetLine
from rig_protocol.system_clock import SystemClockReading

FAST_REQUESTS = 16
FAST_INTERVAL_NS = 20_000_000
REQUEST_INTERVAL_NS = 250_000_000
MAX_OUTSTANDING = 16
# Twenty clock replies, which bring the agent's reading.
SYSTEM_CLOCK_LIFE_NS = 5_000_000_000

_STEP_UNCERTAINTIES = 4
_STEP_MARGIN_NS = 200_000


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """Rig time = agent time + offset, as of the latest exchange.

    `uncertainty_ns` is the standard uncertainty of the offset now; `delay_ns` the least round trip seen.
    """

    offset_ns: int
    drift_ppm: float
    uncertainty_ns: int
    delay_ns: int
    samples: int
    source: Literal["exchange", "system"] = "exchange"


class _SystemOffset(NamedTuple):
    """The offset by both machines' disciplined wall clocks. It does not drift: their daemons see to that."""

    offset_ns: int
    uncertainty_ns: float
    expires_ns: int


class ClockSync:
    """Asks one agent for its time, estimates offset and drift, notices steps."""

    def __init__(self, now_ns: int) -> None:
        self._filter = OffsetFilter()
        self._outstanding: deque[int] = deque(maxlen=MAX_OUTSTANDING)
        self._line: OffsetLine | None = None
        self._asymmetry_ns = 0.0
        self._system: _SystemOffset | None = None
        self._fast_left = FAST_REQUESTS
        self._last_request_ns = now_ns - REQUEST_INTERVAL_NS
        self.steps = 0
        self.system_clock_disagreements = 0

    @property
    def next_request_ns(self) -> int:
        """When the next request is due."""
        return self._last_request_ns + (FAST_INTERVAL_NS if self._fast_left else REQUEST_INTERVAL_NS)

    def request(self, now_ns: int) -> ClockRequest:
        """The request to send at `now_ns`."""
        self._outstanding.append(now_ns)
        self._last_request_ns = now_ns
        self._fast_left = max(0, self._fast_left - 1)
        return ClockRequest(now_ns)

    def hurry(self) -> None:
        """Ask soon: something does not agree with the estimate."""
        self._fast_left = max(1, self._fast_left)

    def receive(self, reply: ClockReply, now_ns: int) -> bool:
        """Take a reply that arrived at `now_ns`; False where it answers nothing or cannot be true."""
        delay_ns = (now_ns - reply.t1_ns) - (reply.t3_ns - reply.t2_ns)
        if reply.t1_ns not in self._outstanding or reply.t3_ns < reply.t2_ns or delay_ns < 0:
            return False
        self._outstanding.remove(reply.t1_ns)
        agent_ns = (reply.t2_ns + reply.t3_ns) // 2
        offset_ns = ((reply.t1_ns - reply.t2_ns) + (now_ns - reply.t3_ns)) // 2
        if self._contradicts(agent_ns, offset_ns, delay_ns):
            self.steps += 1
            self._filter.clear()
            self._system = None
            self._fast_left = FAST_REQUESTS
        self._line = self._filter.add(agent_ns, offset_ns, delay_ns)
        # Nothing tells how the least delay is shared between the two ways: evenly spread.
        self._asymmetry_ns = self._filter.least_delay_ns / 2 / math.sqrt(3)
        if self._system is not None and self._system.expires_ns <= now_ns:
            self._system = None
        return True

    def use_system_clocks(
        self, agent: SystemClockReading | None, rig: SystemClockReading | None, now_ns: int
    ) -> None:
        """Take what both machines say of their wall clocks at `now_ns`; None: nothing is known.

        Two disciplined wall clocks show the same time, so their readings give the offset. It counts while it
        is better than the exchange's, for at most SYSTEM_CLOCK_LIFE_NS. One that the exchange disproves is
        ignored and counted: a daemon follows another source, or claims too much.
        """
        self._system = None
        if self._line is None or agent is None or rig is None:
            return
        if agent.error_ns is None or rig.error_ns is None or min(agent.error_ns, rig.error_ns) < 0:
            return
        offset_ns = agent.wall_minus_monotonic_ns - rig.wall_minus_monotonic_ns
        uncertainty_ns = math.hypot(agent.error_ns, rig.error_ns)
        exchanged_ns, exchanged_uncertainty_ns = self._exchanged(self._line, self._line.agent_ns)
        allowed_ns = uncertainty_ns + exchanged_uncertainty_ns + self._filter.least_delay_ns / 2
        if abs(offset_ns - exchanged_ns) > allowed_ns:
            self.system_clock_disagreements += 1
        else:
            self._system = _SystemOffset(offset_ns, uncertainty_ns, now_ns + SYSTEM_CLOCK_LIFE_NS)

    def to_rig(self, agent_time_ns: int) -> tuple[int, int] | None:
        """Rig time and its standard uncertainty (ns) of an agent time; None before the first sample."""
        if self._line is None:
            return None
        offset_ns, uncertainty_ns, _ = self._offset_at(self._line, agent_time_ns)
        return agent_time_ns + offset_ns, math.ceil(uncertainty_ns)

    @property
    def estimate(self) -> ClockEstimate | None:
        """The estimate as of the latest sample; None before the first."""
        if self._line is None:
            return None
        offset_ns, uncertainty_ns, source = self._offset_at(self._line, self._line.agent_ns)
        return ClockEstimate(
            offset_ns,
            0.0 if source == "system" else self._line.drift * 1e6,
            math.ceil(uncertainty_ns),
            self._filter.least_delay_ns,
            len(self._filter),
            source,
        )

    def _offset_at(self, line: OffsetLine, agent_ns: int) -> tuple[int, float, Literal["exchange", "system"]]:
        """The better offset at an agent time, its standard uncertainty, and whose it is."""
        offset_ns, uncertainty_ns = self._exchanged(line, agent_ns)
        if self._system is not None and self._system.uncertainty_ns < uncertainty_ns:
            return self._system.offset_ns, self._system.uncertainty_ns, "system"
        return offset_ns, uncertainty_ns, "exchange"

    def _exchanged(self, line: OffsetLine, agent_ns: int) -> tuple[int, float]:
        """Offset by the exchange and its standard uncertainty, with the path's asymmetry."""
        offset_ns, uncertainty_ns = line.at(agent_ns)
        return offset_ns, math.hypot(uncertainty_ns, self._asymmetry_ns)

    def _contradicts(self, agent_ns: int, offset_ns: int, delay_ns: int) -> bool:
        """True when estimate and sample cannot both be right: a clock jumped.

        The path's asymmetry is in both, so that only what delays exceed the least one is doubtful. It takes
        some samples to know that.
        """
        if self._line is None:
            return False
        expected_ns, uncertainty_ns = self._line.at(agent_ns)
        least_ns = self._filter.least_delay_ns
        if len(self._filter) < FAST_REQUESTS:
            doubt_ns = (abs(delay_ns - least_ns) + least_ns) / 2
        else:
            doubt_ns = (abs(delay_ns - least_ns) + self._line.unseen_ns) / 2
        allowed_ns = doubt_ns + _STEP_UNCERTAINTIES * uncertainty_ns + _STEP_MARGIN_NS
        return abs(offset_ns - expected_ns) > allowed_ns
