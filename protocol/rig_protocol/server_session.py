"""One camera's session at the server: reassembly, clock, stream plan, liveness, loss by cause."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import ceil, hypot

from rig_protocol.clock_sync import ClockEstimate, ClockSync
from rig_protocol.counters import CameraCounters
from rig_protocol.datagram import Buffer, FragmentHeader
from rig_protocol.errors import LinkUsageError
from rig_protocol.events import Address
from rig_protocol.frames import EncodedFrame
from rig_protocol.gravity import Gravity
from rig_protocol.handshake import Agreement
from rig_protocol.message_bytes import encode_body
from rig_protocol.messages import ClockReply, Heartbeat, Hello, Message, StreamChoice, StreamPlan
from rig_protocol.reassembler import Reassembler
from rig_protocol.remote_control import ControlSender
from rig_protocol.resend_budget import ResendBudget
from rig_protocol.sealed_channel import SealedChannel
from rig_protocol.security import FrameSeal
from rig_protocol.system_clock import SystemClockReading

SILENCE_NS = 2_000_000_000
# A frame is in the past when it arrives; clocks and their reading err by so much beyond the uncertainty.
_FUTURE_MARGIN_NS = 1_000_000
_FUTURE_UNCERTAINTIES = 4
# What a heartbeat tells of gravity holds for frames that come so soon after it: four heartbeats.
GRAVITY_AGE_NS = 2_000_000_000
# No queue of an agent holds frames for so long: an older stamp is a wrong one.
MAX_FRAME_AGE_NS = 10_000_000_000
# Frames of a new session that overtake its first clock reply: 130 ms at 30 frames/s.
_MAX_EARLY = 4


@dataclass(slots=True)
class CameraStatus:
    """What the operator may know of one camera; it outlives the camera's sessions."""

    camera_id: int
    name: str
    address: Address
    hello: Hello
    connected: bool = True
    counters: CameraCounters = field(default_factory=CameraCounters)
    clock: ClockEstimate | None = None
    health: Mapping[str, float] = field(default_factory=dict)

    def joined(self, hello: Hello, address: Address) -> None:
        """A new session of this camera begins: nothing is known of its clock."""
        self.name, self.hello, self.address = hello.name, hello, address
        self.connected, self.clock = True, None
        self.counters.sessions += 1


class ServerSession:
    """From the first authentic message of one camera to its goodbye or silence. Counts into `status`.

    `due_ns` is never later than the moment at which `handle_timeout` has something to do.
    """

    def __init__(
        self, status: CameraStatus, agreement: Agreement, resend_budget: ResendBudget, now_ns: int
    ) -> None:
        welcome, keys = agreement.welcome, agreement.keys
        self.status = status
        self.address = status.address  # a session is bound to it; the status may move on
        self.welcome = welcome
        self.last_heard_ns = now_ns
        self._choice: StreamChoice | None = None
        self._channel = SealedChannel(
            welcome.cipher, keys.server_control, keys.agent_control, welcome.session_id
        )
        self._clock = ClockSync(now_ns)
        self._gravity: Gravity | None = None
        self._gravity_ns = now_ns
        self._early: list[tuple[EncodedFrame, int]] = []  # with their arrival; before the clock is known
        self._reassembler = Reassembler(
            welcome.camera_id,
            status.hello.fps,
            status.counters,
            FrameSeal(welcome.cipher, keys),
            resend_budget,
        )
        self.controls = ControlSender()
        self.due_ns = now_ns

    def receive_fragments(
        self, first: FragmentHeader, run: Buffer, count: int, now_ns: int
    ) -> EncodedFrame | None:
        """Take a run of fragments; the frame, in rig time, that it completes and that may be delivered."""
        frame = self._reassembler.receive(first, run, count, now_ns)
        self.due_ns = min(self.due_ns, self._reassembler.due_ns)
        if frame is None:
            return None
        self.last_heard_ns = now_ns
        return self._accept(frame, now_ns)

    def open(self, datagram: Buffer, now_ns: int) -> bytes | str:
        """The body of a sealed datagram, now heard; or the cause for which it is dropped."""
        body = self._channel.open(datagram)
        if not isinstance(body, str):
            self.last_heard_ns = now_ns
        return body

    def choose(self, choice: StreamChoice) -> None:
        """What the agent is to send from now on; LinkUsageError where no plan can tell it."""
        if not (0 <= choice.slot < choice.slots and choice.step_ns > 0):
            raise LinkUsageError(
                f"slot {choice.slot} of {choice.slots} in a step of {choice.step_ns} ns: there is none"
            )
        encode_body(_plan(choice))  # raises where it cannot be sent
        self._choice = choice

    def seal(self, message: Message) -> bytes:
        """The datagram of a message to this agent."""
        return self._channel.seal(*encode_body(message))

    def receive_clock_reply(
        self, reply: ClockReply, rig_system_clock: SystemClockReading | None, now_ns: int
    ) -> list[EncodedFrame]:
        """Take a clock reply into the estimate, and what both machines say of their system clocks.

        The first one gives their time to frames that were quicker than it: those may be delivered now.
        """
        counters, clock = self.status.counters, self._clock
        before = clock.steps, clock.system_clock_disagreements
        if clock.receive(reply, now_ns):
            told = SystemClockReading(reply.wall_minus_agent_ns, reply.wall_error_ns)
            clock.use_system_clocks(told, rig_system_clock, now_ns)
        else:
            counters.bad_clock_reply += 1
        counters.clock_steps += clock.steps - before[0]
        counters.system_clock_disagreements += clock.system_clock_disagreements - before[1]
        self.status.clock = self._clock.estimate
        self.due_ns = min(self.due_ns, self._clock.next_request_ns)
        early, self._early = self._early, []
        delivered = (self._deliver(frame, received_ns, now_ns) for frame, received_ns in early)
        return [frame for frame in delivered if frame is not None]

    def receive_heartbeat(self, heartbeat: Heartbeat, now_ns: int) -> None:
        """The agent's gauges, which way it feels down, and how many frames it has sent."""
        self.status.health = heartbeat.health
        self._gravity, self._gravity_ns = heartbeat.gravity, now_ns
        self._reassembler.heard_of(heartbeat.frames, now_ns)
        self.due_ns = min(self.due_ns, self._reassembler.due_ns)

    def periodic_messages(self, now_ns: int, rig_clock: str | None = None) -> list[bytes]:
        """The clock request, stamped now, and the stream plan with it, where they are due.

        `rig_clock`: the name of the clock that `now_ns` is of.
        """
        if self._clock.next_request_ns > now_ns:
            return []
        messages: list[Message] = [self._clock.request(now_ns)]
        clock = self._clock.estimate
        if self._choice is not None and clock is not None:
            messages.append(_plan(self._choice, clock.offset_ns, clock.uncertainty_ns, rig_clock))
        self._refresh_due()
        return [self.seal(message) for message in messages]

    def _refresh_due(self) -> None:
        """When there is something to do next."""
        self.due_ns = min(
            self._clock.next_request_ns,
            self.last_heard_ns + SILENCE_NS,
            self._reassembler.due_ns,
            self.controls.due_ns,
        )

    def silent(self, now_ns: int) -> bool:
        """True when the agent must be taken as gone."""
        return now_ns - self.last_heard_ns >= SILENCE_NS

    def handle_timeout(self, now_ns: int) -> list[bytes]:
        """Give up the frames whose time is over; requests for missed fragments, and the control in flight."""
        requests: list[Message] = [*self._reassembler.handle_timeout(now_ns)]
        requests += self.controls.messages_due(now_ns)
        self._refresh_due()
        return [self.seal(request) for request in requests]

    def close(self) -> None:
        """The session is over: count what it leaves unfinished."""
        self._reassembler.close()
        self.status.counters.untimed += len(self._early)
        self.status.connected = False

    def _accept(self, frame: EncodedFrame, now_ns: int) -> EncodedFrame | None:
        if not self.welcome.allows(frame):
            self.status.counters.unexpected_codec += 1
            return None
        if self._clock.estimate is None and len(self._early) < _MAX_EARLY:
            self._early.append((frame, now_ns))
            return None
        return self._deliver(frame, now_ns, now_ns)

    def _deliver(self, frame: EncodedFrame, received_ns: int, now_ns: int) -> EncodedFrame | None:
        """The frame in rig time; None (counted) where its time is not known or cannot be true."""
        counters = self.status.counters
        stamp = self._stamp(frame.timestamp_ns, now_ns)
        if stamp is None:
            counters.untimed += 1
            return None
        counters.frames += 1
        counters.damaged += frame.damaged
        timestamp_ns, uncertainty_ns = stamp
        total_ns = ceil(hypot(uncertainty_ns, frame.uncertainty_ns))
        return replace(
            frame,
            timestamp_ns=timestamp_ns,
            uncertainty_ns=total_ns,
            received_ns=received_ns,
            gravity=self._gravity if abs(received_ns - self._gravity_ns) <= GRAVITY_AGE_NS else None,
        )

    def _stamp(self, agent_time_ns: int, now_ns: int) -> tuple[int, int] | None:
        """Rig time and its uncertainty; None where it is not known or cannot be true."""
        mapped = self._clock.to_rig(agent_time_ns)
        if mapped is None:
            return None
        timestamp_ns, uncertainty_ns = mapped
        latest_ns = now_ns + _FUTURE_UNCERTAINTIES * uncertainty_ns + _FUTURE_MARGIN_NS
        if not now_ns - MAX_FRAME_AGE_NS <= timestamp_ns <= latest_ns:
            self._clock.hurry()
            self.due_ns = min(self.due_ns, self._clock.next_request_ns)
            return None
        return mapped


def _plan(
    choice: StreamChoice,
    offset_ns: int = 0,
    uncertainty_ns: int | None = None,
    rig_clock: str | None = None,
) -> StreamPlan:
    """A choice for an agent whose time plus `offset_ns` is rig time."""
    return StreamPlan(
        color_codec=choice.color_codec,
        depth_codec=choice.depth_codec,
        fps=choice.fps,
        step_ns=choice.step_ns,
        phase_ns=choice.phase_ns,
        spread=choice.spread,
        offset_ns=offset_ns,
        offset_uncertainty_ns=uncertainty_ns,
        rig_clock=rig_clock,
    )
