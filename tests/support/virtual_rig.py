"""A whole rig in virtual time: real links, pacers and synchroniser, lossy paths, no socket and no real clock.

What it shows is the protocol's own: no busy machine adds to a delay, and the same seed gives the same
figures.
"""

import heapq
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import count

import numpy as np
import numpy.typing as npt

from rig_agent.pacer import Pacer
from rig_protocol.agent_link import AgentLink
from rig_protocol.datagram import DatagramBatch
from rig_protocol.events import CameraJoined, FrameReceived
from rig_protocol.frames import EncodedFrame, Payload, RgbdFrame
from rig_protocol.server_link import ServerLink
from rig_protocol.synchroniser import Synchroniser
from rig_protocol.testing import AgentClock, Faults, LossyLink
from support.wire import COLOR, DEPTH, make_agent, make_hello, make_server

FRAME_BYTES = 195_000  # a lossless pair of the shared real frames
CAMERAS = 12
INTERVAL_NS = 33_333_333
SPREAD, BURST = 0.8, 8  # as an agent paces by default
WAKE_NS = 300_000  # mean delay until a Pi's program gets to what has arrived for it
START_NS = 10_000_000_000


@dataclass(frozen=True, slots=True)
class DeliveredSet:
    """One set: when it was handed out, the last exposure in it, and how many frames it lacks."""

    delivered_ns: int
    exposed_ns: int
    missing: int


@dataclass(slots=True)
class _Agent:
    link: AgentLink
    address: tuple[str, int]
    uplink: LossyLink
    downlink: LossyLink
    clock: AgentClock
    random: random.Random
    pacer: Pacer[EncodedFrame] = field(init=False)
    awake_ns: int = 0  # the program sees what has arrived from here on
    sequence: int = 0

    def __post_init__(self) -> None:
        self.pacer = Pacer(INTERVAL_NS, SPREAD, BURST, self.link.send_frame)


class VirtualRig:
    """Twelve free-running cameras at 30 frames/s; `run` for some seconds, then look at `sets`."""

    def __init__(self, faults: Faults, seed: int = 0, cameras: int = CAMERAS) -> None:
        self.sets: list[DeliveredSet] = []
        self.server: ServerLink = make_server()
        self._payload = random.Random(seed).randbytes(FRAME_BYTES)
        self._synchroniser = Synchroniser(range(cameras), deadline_ns=100_000_000)
        self._agents = [_make_agent(camera, faults, seed) for camera in range(cameras)]
        self._now_ns = START_NS
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._ticket = count()
        self._tick_ns = 0  # when the server's timer wakes it up next
        for agent in self._agents:
            self._at(self._now_ns, lambda agent=agent: self._serve_agent(agent))
            phase_ns = agent.random.randrange(INTERVAL_NS)
            self._at(self._now_ns + 500_000_000 + phase_ns, lambda agent=agent: self._expose(agent))

    @property
    def counted(self) -> dict[str, int]:
        """Counters of all cameras together that are not zero."""
        counters = [status.counters for status in self.server.cameras.values()]
        names = type(counters[0]).__slots__
        totals = {name: sum(getattr(one, name) for one in counters) for name in names}
        return {name: total for name, total in totals.items() if total}

    def run(self, seconds: float) -> "VirtualRig":
        """Let so much time pass."""
        end_ns = self._now_ns + round(seconds * 1e9)
        while self._events and self._events[0][0] <= end_ns:
            self._now_ns, _, action = heapq.heappop(self._events)
            action()
        self._now_ns = end_ns
        return self

    def _at(self, time_ns: int, action: Callable[[], None]) -> None:
        heapq.heappush(self._events, (max(time_ns, self._now_ns), next(self._ticket), action))

    # ---- agents

    def _expose(self, agent: _Agent) -> None:
        self._at(self._now_ns + INTERVAL_NS, lambda: self._expose(agent))
        agent_ns = agent.clock.read(self._now_ns)
        split = 2 * FRAME_BYTES // 3
        frame = EncodedFrame(
            camera_id=0,
            sequence=agent.sequence,
            timestamp_ns=agent_ns,
            color=Payload(COLOR, self._payload[:split]),
            depth=Payload(DEPTH, self._payload[split:]),
        )
        agent.sequence += 1
        if agent.link.connected:
            given_up = agent.pacer.submit(frame, agent_ns)
            if given_up is not None:
                agent.link.give_up_frame(given_up)
            self._serve_agent(agent)

    def _serve_agent(self, agent: _Agent) -> None:
        agent_ns = agent.clock.read(self._now_ns)
        for datagram in agent.downlink.arrivals(self._now_ns):
            agent.link.receive_datagram(datagram, agent_ns)
        agent.link.handle_timeout(agent_ns)
        while agent.link.next_event() is not None:
            continue
        for datagram in agent.link.datagrams_to_send(agent_ns):
            agent.uplink.send(datagram, self._now_ns)
        for batch in agent.link.frames_to_resend(agent.pacer.sent_of):
            agent.pacer.resend(batch)
        while (again := agent.pacer.next_resend(agent_ns)) is not None:
            self._transmit(agent, again)
        burst = agent.pacer.next_burst(agent_ns)
        if burst is not None:
            self._transmit(agent, burst)
            agent.pacer.sent(len(burst), agent_ns)
        dues = [agent.link.next_timeout_ns(), agent.pacer.next_timeout_ns()]
        due_ns = min(agent.clock.true_time(due) for due in dues if due is not None)
        if due_ns < agent.awake_ns or agent.awake_ns <= self._now_ns:
            agent.awake_ns = due_ns
            self._at(due_ns, lambda: self._wake(agent, due_ns))
        self._expect(agent)

    def _wake(self, agent: _Agent, due_ns: int) -> None:
        if agent.awake_ns == due_ns:  # else another moment took its place
            self._serve_agent(agent)

    def _transmit(self, agent: _Agent, batch: DatagramBatch) -> None:
        for datagram in batch:
            agent.uplink.send(bytes(datagram), self._now_ns)

    def _expect(self, agent: _Agent) -> None:
        arrival_ns = agent.uplink.next_arrival_ns
        if arrival_ns is not None:
            self._at(arrival_ns, lambda: self._serve_server(agent))

    # ---- server

    def _serve_server(self, agent: _Agent) -> None:
        server, now_ns = self.server, self._now_ns
        for datagram in agent.uplink.arrivals(now_ns):
            server.receive_datagram(datagram, agent.address, now_ns)
        self._take_events()
        self._tick_server()
        self._expect(agent)

    def _tick_server(self) -> None:
        server, now_ns = self.server, self._now_ns
        due_ns = server.next_timeout_ns()
        if due_ns is not None and due_ns <= now_ns:
            server.handle_timeout(now_ns)
            due_ns = server.next_timeout_ns()
        for datagram, address in server.datagrams_to_send(now_ns):
            self._answer(next(agent for agent in self._agents if agent.address == address), datagram)
        if due_ns is not None and not self._now_ns < self._tick_ns <= due_ns:
            self._tick_ns = due_ns  # else it wakes up before that anyway
            self._at(due_ns, self._tick_server)
        self._collect()

    def _answer(self, agent: _Agent, datagram: bytes) -> None:
        agent.downlink.send(datagram, self._now_ns)
        arrival_ns = agent.downlink.next_arrival_ns
        if arrival_ns is not None:
            wake_ns = arrival_ns + round(agent.random.expovariate(1 / WAKE_NS))
            self._at(wake_ns, lambda: self._serve_agent(agent))

    def _take_events(self) -> None:
        while (event := self.server.next_event()) is not None:
            if isinstance(event, CameraJoined):
                self._synchroniser.camera_joined(event.camera_id, event.hello.fps)
            elif isinstance(event, FrameReceived):
                self._synchroniser.add(_decoded(event.frame), self._now_ns)

    def _collect(self) -> None:
        while (panorama := self._synchroniser.next_panorama(self._now_ns)) is not None:
            exposed_ns = max(frame.timestamp_ns for frame in panorama.frames.values() if frame is not None)
            self.sets.append(DeliveredSet(self._now_ns, exposed_ns, len(panorama.missing)))


def _make_agent(camera: int, faults: Faults, seed: int) -> _Agent:
    generator = random.Random(1000 * seed + camera)
    return _Agent(
        link=make_agent(make_hello(camera_id=camera, serial=f"S{camera}"), seed=1000 * seed + camera),
        address=(f"192.0.2.{camera}", 40_000),
        uplink=LossyLink(generator.getrandbits(32), faults),
        downlink=LossyLink(generator.getrandbits(32), faults),
        clock=AgentClock(camera * 10**11, generator.uniform(-50, 50)),
        random=generator,
    )


def _decoded(frame: EncodedFrame) -> RgbdFrame:
    return RgbdFrame(frame.camera_id, frame.sequence, frame.timestamp_ns, received_ns=frame.received_ns)


def latencies_ms(sets: Sequence[DeliveredSet]) -> npt.NDArray[np.float64]:
    """From the last exposure of each set to the set."""
    return np.array([(one.delivered_ns - one.exposed_ns) / 1e6 for one in sets])
