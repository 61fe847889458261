"""One camera's session at the server: reassembly, clock, liveness, loss by cause."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import ceil, hypot

from rig_protocol.clock_sync import ClockEstimate, ClockSync
from rig_protocol.counters import CameraCounters
from rig_protocol.datagram import Buffer, FragmentHeader
from rig_protocol.events import Address
from rig_protocol.frames import EncodedFrame
from rig_protocol.messages import ClockReply, ClockRequest, Hello, Welcome
from rig_protocol.reassembler import Reassembler

SILENCE_NS = 2_000_000_000
# A frame is in the past when it arrives; clocks and their reading err by so much beyond the uncertainty.
_FUTURE_MARGIN_NS = 1_000_000
_FUTURE_UNCERTAINTIES = 4
# No queue of an agent holds frames for so long: an older stamp is a wrong one.
MAX_FRAME_AGE_NS = 10_000_000_000


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
    """From the welcome of one camera to its goodbye or silence. Counts into `status`."""

    def __init__(self, status: CameraStatus, hello_nonce: int, welcome: Welcome, now_ns: int) -> None:
        self.status = status
        self.address = status.address  # a session is bound to it; the status may move on
        self.hello_nonce = hello_nonce
        self.welcome = welcome
        self.last_heard_ns = now_ns
        self._clock = ClockSync(now_ns)
        self._reassembler = Reassembler(welcome.camera_id, status.hello.fps, status.counters)

    def receive_fragments(
        self, first: FragmentHeader, run: Buffer, count: int, now_ns: int
    ) -> EncodedFrame | None:
        """Take a run of fragments; the frame, in rig time, that it completes and that may be delivered."""
        frame = self._reassembler.receive(first, run, count, now_ns)
        return None if frame is None else self._accept(frame, now_ns)

    def receive_clock_reply(self, reply: ClockReply, now_ns: int) -> None:
        """Take a clock reply into the estimate."""
        counters = self.status.counters
        steps_before = self._clock.steps
        if not self._clock.receive(reply, now_ns):
            counters.bad_clock_reply += 1
        counters.clock_steps += self._clock.steps - steps_before
        self.status.clock = self._clock.estimate

    def clock_request(self, now_ns: int) -> ClockRequest | None:
        """The clock request that is due now, if any."""
        return self._clock.request(now_ns) if self._clock.next_request_ns <= now_ns else None

    def silent(self, now_ns: int) -> bool:
        """True when the agent must be taken as gone."""
        return now_ns - self.last_heard_ns >= SILENCE_NS

    def expire(self, now_ns: int) -> None:
        """Give up the frames whose time is over."""
        self._reassembler.expire(now_ns)

    def close(self) -> None:
        """The session is over: count what it leaves unfinished."""
        self._reassembler.close()
        self.status.connected = False

    @property
    def next_timeout_ns(self) -> int:
        """When the session has something to do next."""
        due_ns = min(self._clock.next_request_ns, self.last_heard_ns + SILENCE_NS)
        deadline_ns = self._reassembler.next_deadline_ns
        return due_ns if deadline_ns is None else min(due_ns, deadline_ns)

    def _accept(self, frame: EncodedFrame, now_ns: int) -> EncodedFrame | None:
        counters = self.status.counters
        if not self.welcome.allows(frame):
            counters.unexpected_codec += 1
            return None
        stamped = self._stamp(frame, now_ns)
        if stamped is None:
            counters.untimed += 1
            return None
        counters.frames += 1
        counters.damaged += frame.damaged
        return stamped

    def _stamp(self, frame: EncodedFrame, now_ns: int) -> EncodedFrame | None:
        """The frame in rig time; None where its time is not known or cannot be true."""
        mapped = self._clock.to_rig(frame.timestamp_ns)
        if mapped is None:
            return None
        timestamp_ns, uncertainty_ns = mapped
        latest_ns = now_ns + _FUTURE_UNCERTAINTIES * uncertainty_ns + _FUTURE_MARGIN_NS
        if not now_ns - MAX_FRAME_AGE_NS <= timestamp_ns <= latest_ns:
            self._clock.hurry()
            return None
        total_ns = ceil(hypot(uncertainty_ns, frame.uncertainty_ns))
        return replace(frame, timestamp_ns=timestamp_ns, uncertainty_ns=total_ns, received_ns=now_ns)
