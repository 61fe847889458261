"""One session as the agent has it: sealing, heartbeats, clock replies, what it may be asked for again."""

from collections import deque
from collections.abc import Callable, Mapping

from rig_protocol.datagram import Buffer, DatagramBatch
from rig_protocol.fragmenter import fragment
from rig_protocol.frame_history import FrameHistory
from rig_protocol.frames import EncodedFrame
from rig_protocol.gravity import Gravity
from rig_protocol.handshake import Agreement
from rig_protocol.message_bytes import encode_body
from rig_protocol.messages import ClockReply, ClockRequest, Goodbye, Heartbeat, Message, Resend
from rig_protocol.sealed_channel import SealedChannel
from rig_protocol.security import FrameSeal
from rig_protocol.system_clock import SystemClockReading

HEARTBEAT_INTERVAL_NS = 500_000_000
# Until the server is heard for the first time: the first heartbeat is what begins the session there.
CONFIRM_INTERVAL_NS = 50_000_000
SILENCE_NS = 2_000_000_000
# The server sends sixteen requests in a row; each is answered at the next turn of the shell.
_MAX_CLOCK_REQUESTS = 16
# Four rounds of requests for every frame that is still held.
_MAX_RESENDS = 32


class AgentSession:
    """From the server's welcome to its silence."""

    def __init__(self, agreement: Agreement, now_ns: int) -> None:
        self.welcome = agreement.welcome
        self.confirmed = False  # a sealed message of the server has come
        self.heard_ns = now_ns
        self.history = FrameHistory()
        keys, session_id = agreement.keys, self.welcome.session_id
        self._channel = SealedChannel(
            self.welcome.cipher, keys.agent_control, keys.server_control, session_id
        )
        self._seal = FrameSeal(self.welcome.cipher, keys)
        self._heartbeat_due_ns = now_ns
        self._tells_gravity = False  # the latest heartbeat did
        self._frame_number = 0
        self._sent_frames = 0  # all below this number have left, as of the latest `answer_resends`
        self._clock_requests: deque[tuple[ClockRequest, int]] = deque(maxlen=_MAX_CLOCK_REQUESTS)
        self._resends: deque[Resend] = deque(maxlen=_MAX_RESENDS)

    @property
    def next_timeout_ns(self) -> int:
        """When the session has something to say, or is over."""
        return min(self._heartbeat_due_ns, self.heard_ns + SILENCE_NS)

    @property
    def has_clock_requests(self) -> bool:
        """True while the server waits for the time."""
        return bool(self._clock_requests)

    def open(self, datagram: Buffer, now_ns: int) -> bytes | str:
        """The body of a sealed datagram, now heard; or the cause for which it is dropped."""
        body = self._channel.open(datagram)
        if not isinstance(body, str):
            self.heard_ns = now_ns
        return body

    def seal(self, message: Message) -> bytes:
        """The datagram of a message to the server."""
        return self._channel.seal(*encode_body(message))

    def last_words(self, text: str, health: Mapping[str, float]) -> list[bytes]:
        """A goodbye, and before it how many frames have left, so that the last ones are accounted for."""
        return [self.seal(Heartbeat(health, self._sent_frames)), self.seal(Goodbye(text))]

    def take_clock_request(self, request: ClockRequest, now_ns: int) -> None:
        """Answer with the next datagrams."""
        self._clock_requests.append((request, now_ns))

    def take_resend(self, resend: Resend) -> None:
        """Answer with the next datagrams; the oldest request gives way when too many wait."""
        self._resends.append(resend)

    def datagrams_to_send(
        self,
        now_ns: int,
        health: Mapping[str, float],
        gravity: Gravity | None,
        system_clock: SystemClockReading | None,
    ) -> list[bytes]:
        """Clock replies, stamped with `now_ns`, and the heartbeat where it is due.

        It is due at once when the camera begins to feel gravity, or ceases to because it is moved.
        """
        datagrams = [
            self.seal(_reply(request, received_ns, now_ns, system_clock))
            for request, received_ns in self._clock_requests
        ]
        self._clock_requests.clear()
        changed = (gravity is not None) != self._tells_gravity
        if changed or is_due(self._heartbeat_due_ns, now_ns, HEARTBEAT_INTERVAL_NS):
            self._tells_gravity = gravity is not None
            interval_ns = HEARTBEAT_INTERVAL_NS if self.confirmed else CONFIRM_INTERVAL_NS
            self._heartbeat_due_ns = now_ns + interval_ns
            datagrams.append(self.seal(Heartbeat(health, self._sent_frames, gravity)))
        return datagrams

    def cut(self, frame: EncodedFrame, datagram_size: int) -> DatagramBatch:
        """The sealed datagrams of the next frame, remembered for a while."""
        size = min(datagram_size, self.welcome.datagram_size)
        # Taken before it is used: whatever fails, no number seals two frames.
        number, self._frame_number = self._frame_number, self._frame_number + 1
        batch = fragment(frame, self.welcome.session_id, number, self._seal, size)
        self.history.add(number, batch)
        return batch

    def answer_resends(self, sent_of: Callable[[DatagramBatch], int]) -> tuple[list[DatagramBatch], int]:
        """What to send again now, and how many fragments were refused."""
        unsent = self.history.first_unsent(sent_of)
        self._sent_frames = self._frame_number if unsent is None else unsent
        batches: list[DatagramBatch] = []
        refused = self.history.refused
        while self._resends:
            resend = self._resends.popleft()
            held = self.history.find(resend.frame_number)
            batches += self.history.answer(resend, 0 if held is None else sent_of(held))
        return batches, self.history.refused - refused


def is_due(due_ns: int, now_ns: int, longest_wait_ns: int) -> bool:
    """True at `due_ns`, and when the clock jumped back so far that it could not be that long."""
    return now_ns >= due_ns or due_ns - now_ns > longest_wait_ns


def _reply(
    request: ClockRequest, received_ns: int, now_ns: int, system_clock: SystemClockReading | None
) -> ClockReply:
    if system_clock is None:
        return ClockReply(request.t1_ns, received_ns, now_ns)
    return ClockReply(
        request.t1_ns,
        received_ns,
        now_ns,
        system_clock.wall_minus_monotonic_ns,
        system_clock.error_ns,
    )
