"""Faults and time on demand: a seeded lossy link, and a network of links that lives in virtual time.

For tests of everything that stands on the links: no socket, no thread, no real clock.
"""

import heapq
import random
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from rig_protocol.agent_link import AgentLink
from rig_protocol.datagram import DatagramBatch
from rig_protocol.events import Address, AgentEvent, ControlRequested, ServerEvent
from rig_protocol.frames import EncodedFrame
from rig_protocol.server_link import ServerLink

_MOST_BIT_ERRORS = 3  # in one corrupt datagram
_CUT_SHARE = 0.2  # of corrupt datagrams lose their end instead
_NEVER_NS = 2**63


@dataclass(frozen=True, slots=True)
class Faults:
    """What a link does to datagrams. Fractions are probabilities for each datagram."""

    drop: float = 0.0
    burst: float = 0.0  # that a burst of losses begins here
    burst_length: int = 10
    duplicate: float = 0.0
    reorder: float = 0.0  # that it comes `reorder_ns` later than its turn
    reorder_ns: int = 5_000_000
    delay_ns: int = 100_000
    jitter_ns: int = 0  # mean of an exponential delay on top
    corrupt: float = 0.0  # bits flipped, or the end cut off
    outage_ns: int = 0  # nothing passes for so long ...
    outage_interval_ns: int = 1_000_000_000  # ... once in so much time on average


class LossyLink:
    """One direction of a network path: datagrams in at one time, out at another, some of them harmed."""

    def __init__(self, seed: int, faults: Faults = Faults()) -> None:
        self.faults = faults
        self.done: Counter[str] = Counter()
        self._random = random.Random(seed)
        self._burst_left = 0
        self._outage_ns = self._next_outage_ns(0)
        self._under_way: list[tuple[int, int, bytes]] = []
        self._sent = 0

    def send(self, datagram: bytes, now_ns: int) -> None:
        """Put a datagram on the link."""
        self.done["sent"] += 1
        if self._is_out(now_ns) or self._is_lost():
            self.done["lost"] += 1
            return
        copies = 2 if self._happens("duplicate", self.faults.duplicate) else 1
        for _ in range(copies):
            self._depart(datagram, now_ns)

    def arrivals(self, now_ns: int) -> Iterator[bytes]:
        """The datagrams that have arrived by `now_ns`, in the order of their arrival."""
        while self._under_way and self._under_way[0][0] <= now_ns:
            yield heapq.heappop(self._under_way)[2]

    @property
    def next_arrival_ns(self) -> int | None:
        """When the next datagram arrives; None while none is under way."""
        return self._under_way[0][0] if self._under_way else None

    def _is_out(self, now_ns: int) -> bool:
        if not self.faults.outage_ns:
            return False
        if now_ns >= self._outage_ns + self.faults.outage_ns:
            self._outage_ns = self._next_outage_ns(now_ns)
        return now_ns >= self._outage_ns

    def _next_outage_ns(self, now_ns: int) -> int:
        return now_ns + round(self._random.expovariate(1 / self.faults.outage_interval_ns))

    def _is_lost(self) -> bool:
        if self._burst_left == 0 and self._random.random() < self.faults.burst:
            self._burst_left = self.faults.burst_length
        if self._burst_left:
            self._burst_left -= 1
            return True
        return self._random.random() < self.faults.drop

    def _depart(self, datagram: bytes, now_ns: int) -> None:
        faults = self.faults
        arrival_ns = now_ns + faults.delay_ns
        if faults.jitter_ns:
            arrival_ns += round(self._random.expovariate(1 / faults.jitter_ns))
        if self._happens("reordered", faults.reorder):
            arrival_ns += faults.reorder_ns
        if self._happens("corrupted", faults.corrupt):
            datagram = self._corrupted(datagram)
        self._sent += 1
        heapq.heappush(self._under_way, (arrival_ns, self._sent, datagram))

    def _happens(self, name: str, probability: float) -> bool:
        happens = self._random.random() < probability
        self.done[name] += happens
        return happens

    def _corrupted(self, datagram: bytes) -> bytes:
        if not datagram or self._random.random() < _CUT_SHARE:
            return datagram[: self._random.randrange(max(1, len(datagram)))]
        harmed = bytearray(datagram)
        bits = range(8 * len(datagram))
        for bit in self._random.sample(bits, min(self._random.randint(1, _MOST_BIT_ERRORS), len(bits))):
            harmed[bit // 8] ^= 1 << bit % 8
        return bytes(harmed)


@dataclass(slots=True)
class AgentClock:
    """An agent's clock: off by an offset, too fast by a drift."""

    offset_ns: int = 0
    drift_ppm: float = 0.0

    def read(self, true_ns: int) -> int:
        """Agent time at a true time."""
        return true_ns + round(true_ns * self.drift_ppm * 1e-6) + self.offset_ns

    def true_time(self, agent_ns: int) -> int:
        """True time at an agent time, never early."""
        return round((agent_ns - self.offset_ns) / (1 + self.drift_ppm * 1e-6)) + 1


@dataclass(slots=True)
class VirtualAgent:
    """An agent's link on the virtual network, and what became of it."""

    link: AgentLink
    address: Address
    uplink: LossyLink
    downlink: LossyLink
    clock: AgentClock = field(default_factory=AgentClock)
    make_frame: Callable[[int, int], EncodedFrame] | None = None  # of sequence and agent time
    frame_interval_ns: int = 33_333_333
    next_frame_ns: int = 0
    sequence: int = 0
    events: list[AgentEvent] = field(default_factory=list)
    obey: Callable[[ControlRequested], str] | None = None  # does what a control says; in words

    def due_times(self) -> list[int]:
        """True times at which something happens here."""
        due_ns = self.link.next_timeout_ns()
        times = [None if due_ns is None else self.clock.true_time(due_ns)]
        times += [self.uplink.next_arrival_ns, self.downlink.next_arrival_ns]
        times += [self.next_frame_ns if self.make_frame else None]
        return [time_ns for time_ns in times if time_ns is not None]

    def serve(self, now_ns: int) -> None:
        """What the agent's shell does in one turn."""
        agent_ns = self.clock.read(now_ns)
        for datagram in self.downlink.arrivals(now_ns):
            self.link.receive_datagram(datagram, agent_ns)
        self.link.handle_timeout(agent_ns)
        while (event := self.link.next_event()) is not None:
            self.events.append(event)
            if isinstance(event, ControlRequested) and self.obey is not None:
                self.link.answer_control(event, done=True, text=self.obey(event))
        for datagram in self.link.datagrams_to_send(agent_ns):
            self.uplink.send(datagram, now_ns)
        if self.make_frame is not None and now_ns >= self.next_frame_ns:
            self.next_frame_ns = now_ns + self.frame_interval_ns
            batch = self.link.send_frame(self.make_frame(self.sequence, agent_ns), agent_ns)
            self.sequence += 1
            self._send(batch, now_ns)
        for again in self.link.frames_to_resend(len):
            self._send(again, now_ns)

    def _send(self, batch: DatagramBatch | None, now_ns: int) -> None:
        for fragment in batch or ():
            self.uplink.send(bytes(fragment), now_ns)


class VirtualNetwork:
    """One server link and its agents, wired through lossy links; true time is rig time."""

    def __init__(self, server: ServerLink, start_ns: int = 1_000_000_000) -> None:
        self.server: ServerLink | None = server
        self.agents: list[VirtualAgent] = []
        self.now_ns = start_ns
        self.server_events: list[ServerEvent] = []
        self.strangers: list[tuple[int, bytes, Address]] = []  # what others send: when, bytes, from where

    def run(self, seconds: float) -> None:
        """Let so much time pass."""
        end_ns = self.now_ns + round(seconds * 1e9)
        while (now_ns := self._next_ns()) <= end_ns:
            self.now_ns = max(now_ns, self.now_ns)
            for agent in self.agents:
                agent.serve(self.now_ns)
            self._serve_server()
        self.now_ns = end_ns

    def _next_ns(self) -> int:
        times = [time_ns for time_ns, _, _ in self.strangers]
        times += [due_ns for agent in self.agents for due_ns in agent.due_times()]
        server_due_ns = self.server.next_timeout_ns() if self.server else None
        if server_due_ns is not None:
            times.append(server_due_ns)
        return min(times, default=_NEVER_NS)

    def _serve_server(self) -> None:
        arrived = [
            (data, agent.address) for agent in self.agents for data in agent.uplink.arrivals(self.now_ns)
        ]
        arrived += [(data, address) for time_ns, data, address in self.strangers if time_ns <= self.now_ns]
        self.strangers = [item for item in self.strangers if item[0] > self.now_ns]
        if self.server is None:  # it is down: what arrives is gone
            return
        for datagram, address in arrived:
            self.server.receive_datagram(datagram, address, self.now_ns)
            self._fetch_events(self.server)
        self.server.handle_timeout(self.now_ns)
        self._fetch_events(self.server)
        for datagram, address in self.server.datagrams_to_send(self.now_ns):
            for agent in self.agents:
                if agent.address == address:
                    agent.downlink.send(datagram, self.now_ns)

    def _fetch_events(self, server: ServerLink) -> None:
        while (event := server.next_event()) is not None:
            self.server_events.append(event)
