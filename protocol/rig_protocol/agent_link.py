"""The agent's end of the protocol: one server, one camera. No I/O.

The shell feeds `receive_datagram`, sends `datagrams_to_send`, calls `handle_timeout` when
`next_timeout_ns` is due, fetches `next_event` until None, hands frames to `send_frame` and sends what
`frames_to_resend` gives. Rules: protocol/SPEC.md, sections 6, 7 and 9.
"""

from collections import deque
from collections.abc import Callable, Mapping

from rig_protocol.agent_session import HEARTBEAT_INTERVAL_NS, SILENCE_NS, AgentSession, is_due
from rig_protocol.clear_datagram import clear_crc
from rig_protocol.counters import AgentCounters
from rig_protocol.datagram import (
    DEFAULT_DATAGRAM_SIZE,
    MAGIC,
    MAX_DATAGRAM_SIZE,
    MIN_DATAGRAM_SIZE,
    PREFIX_SIZE,
    VERSION,
    Buffer,
    DatagramBatch,
    MessageType,
    Prefix,
    parse_prefix,
)
from rig_protocol.errors import DataError, LinkUsageError
from rig_protocol.events import AgentEvent, Connected, Disconnected, Rejected
from rig_protocol.frames import EncodedFrame
from rig_protocol.gravity import Gravity
from rig_protocol.handshake import AgentHandshake, NotAuthentic
from rig_protocol.message_bytes import MAX_CONTROL_SIZE, decode_body, encode_body
from rig_protocol.messages import (
    ClockRequest,
    Goodbye,
    Heartbeat,
    Hello,
    Reject,
    Resend,
    StreamPlan,
    Welcome,
)
from rig_protocol.rig_key import RigKey
from rig_protocol.security import RandomBytes
from rig_protocol.system_clock import SystemClockReading

__all__ = ["HEARTBEAT_INTERVAL_NS", "HELLO_RETRY_NS", "REFUSED_RETRY_NS", "SILENCE_NS", "AgentLink"]

# A server that is starting is met within a second; one that refuses needs a person first.
HELLO_RETRY_NS = (100_000_000, 1_000_000_000)
REFUSED_RETRY_NS = (500_000_000, 5_000_000_000)
# A live server asks for the time every 250 ms: when two requests are lost in a row, and a notice says that
# it does not know us, it may be true.
DOUBT_NS = 600_000_000
# Events come at the pace of hellos: an owner that never fetches loses the oldest.
_MAX_EVENTS = 64

_ANSWERS = frozenset({MessageType.WELCOME, MessageType.REJECT})
_SEALED = frozenset({MessageType.GOODBYE, MessageType.CLOCK_REQUEST, MessageType.RESEND, MessageType.PLAN})
_FROM_SERVER = _ANSWERS | _SEALED | {MessageType.UNKNOWN_SESSION}
_ASSIGNED = frozenset(MessageType)


class AgentLink:
    """Says hello until welcome, keeps the session alive, answers the server, cuts up frames."""

    def __init__(
        self,
        hello: Hello,
        rig_key: RigKey,
        random_bytes: RandomBytes,
        datagram_size: int = DEFAULT_DATAGRAM_SIZE,
    ) -> None:
        """`random_bytes` is an unguessable source; LinkUsageError for a hello against the limits."""
        if not MIN_DATAGRAM_SIZE <= datagram_size <= MAX_DATAGRAM_SIZE:
            raise LinkUsageError(
                f"datagram size {datagram_size} is not in {MIN_DATAGRAM_SIZE}..{MAX_DATAGRAM_SIZE}"
            )
        self.counters = AgentCounters()
        self.plan: StreamPlan | None = None
        """What the server wants now, until the next session; None: send as the welcome says."""
        self.gravity: Gravity | None = None
        """Down as the camera feels it now, set by the shell; the next heartbeats tell it."""
        self._hello = hello
        self._rig_key, self._random_bytes = rig_key, random_bytes
        self._datagram_size = datagram_size
        self._closed = False
        self._session: AgentSession | None = None
        self._handshake: AgentHandshake | None = None
        self._health: Mapping[str, float] = {}
        self._last_words: list[bytes] = []
        self._events: deque[AgentEvent] = deque(maxlen=_MAX_EVENTS)
        self._hello_due_ns = 0
        self._awaits_reject = False  # one answer a hello
        self._hello_retry_ns = HELLO_RETRY_NS[0]
        self._refused_retry_ns = REFUSED_RETRY_NS[0]
        self._seek(0)

    @property
    def session(self) -> Welcome | None:
        """The server's choices, from the moment that its first sealed message shows that it is there."""
        session = self._session
        return session.welcome if session is not None and session.confirmed else None

    @property
    def connected(self) -> bool:
        """True between the server's first sealed message and the end of the session."""
        return self.session is not None

    def receive_datagram(self, data: Buffer, now_ns: int) -> None:
        """Take one datagram of the server."""
        prefix = parse_prefix(data)
        cause = "too_short" if prefix is None else self._receive(prefix, data, now_ns)
        if cause is not None:
            self.counters.rejected[cause] += 1

    def datagrams_to_send(self, now_ns: int, system_clock: SystemClockReading | None = None) -> list[bytes]:
        """Control datagrams to transmit now; clock replies are stamped with `now_ns`.

        `system_clock`: what this machine's system clock is worth, for the clock replies.
        """
        if self._closed:
            last_words, self._last_words = self._last_words, []
            return last_words
        datagrams = self._hello_if_due(now_ns)
        if self._session is not None:
            datagrams += self._session.datagrams_to_send(now_ns, self._health, self.gravity, system_clock)
        return datagrams

    @property
    def answers_clock(self) -> bool:
        """True when the next `datagrams_to_send` holds clock replies."""
        return self._session is not None and self._session.has_clock_requests

    def next_timeout_ns(self) -> int | None:
        """When to call `handle_timeout` and `datagrams_to_send` next; None when closed."""
        if self._closed:
            return None
        dues = [] if self._session is None else [self._session.next_timeout_ns]
        if self._handshake is not None:
            dues.append(self._hello_due_ns)
        return min(dues)

    def handle_timeout(self, now_ns: int) -> None:
        """Notice a server that fell silent."""
        session = self._session
        if session is not None and now_ns - session.heard_ns >= SILENCE_NS:
            silence_s = (now_ns - session.heard_ns) / 1e9
            self._lose(f"the server has been silent for {silence_s:.1f} s", now_ns)

    def next_event(self) -> AgentEvent | None:
        """The oldest event that was not fetched yet, or None."""
        return self._events.popleft() if self._events else None

    def send_frame(self, frame: EncodedFrame, now_ns: int) -> DatagramBatch | None:  # noqa: ARG002
        """The datagrams of a frame stamped in agent time; None (counted) where no session can take it.

        LinkUsageError for a frame over the protocol's limits.
        """
        session = self._session
        if session is None or not session.confirmed:
            self.counters.not_connected += 1
            return None
        if not session.welcome.allows(frame):
            self.counters.unexpected_codec += 1
            return None
        batch = session.cut(frame, self._datagram_size)
        self.counters.frames += 1
        self.counters.fragments += len(batch)
        self.counters.bytes += batch.total_bytes
        return batch

    def give_up_frame(self, batch: DatagramBatch) -> None:
        """A frame of `send_frame` will not be sent: a newer one took its place."""
        if self._session is not None:
            self._session.history.forget(batch)

    def frames_to_resend(self, sent_of: Callable[[DatagramBatch], int]) -> list[DatagramBatch]:
        """Datagrams that the server missed, to be sent soon, within the resend budget.

        `sent_of` tells how many datagrams of a frame have left so far: the others come anyway.
        """
        if self._session is None:
            return []
        batches, refused = self._session.answer_resends(sent_of)
        self.counters.resent += sum(map(len, batches))
        self.counters.resend_refused += refused
        return batches

    def report_health(self, health: Mapping[str, float]) -> None:
        """What the next heartbeats tell the operator: at most 16 gauges by name; LinkUsageError otherwise."""
        encode_body(Heartbeat(health))  # raises where it cannot be sent
        self._health = dict(health)

    def close(self, now_ns: int) -> None:  # noqa: ARG002  # the verbs of both links take the time
        """End the session with a goodbye, to be fetched with `datagrams_to_send`; nothing follows."""
        if self._session is not None:
            self._last_words = self._session.last_words("the agent stops", self._health)
        self._closed, self._session, self._handshake = True, None, None

    # ---- dispatch: each returns the name of the cause for which a datagram was dropped

    def _receive(self, prefix: Prefix, data: Buffer, now_ns: int) -> str | None:
        cause = _check(prefix, data)
        if cause is not None:
            return cause
        if prefix.type in _ANSWERS:
            return self._receive_answer(prefix, data, now_ns)
        session = self._session
        if session is None or prefix.id != session.welcome.session_id:
            return "unknown_session"
        if prefix.type == MessageType.UNKNOWN_SESSION:
            return self._receive_notice(session, data, now_ns)
        body = session.open(data, now_ns)
        return body if isinstance(body, str) else self._receive_body(session, prefix.type, body, now_ns)

    def _receive_answer(self, prefix: Prefix, data: Buffer, now_ns: int) -> str | None:
        if self._handshake is None or prefix.id != self._handshake.nonce:
            return "stale_answer"
        try:
            if prefix.type == MessageType.WELCOME:
                agreement = self._handshake.open_welcome(data)
                self._begin(AgentSession(agreement, now_ns))
            else:
                if not self._awaits_reject:  # a copy, or a forged one that would put off the next hello
                    return "stale_answer"
                self._refused(decode_body(prefix.type, bytes(data[PREFIX_SIZE:])), now_ns)
        except NotAuthentic:
            return "bad_seal"
        except DataError:
            return "malformed"
        return None

    def _receive_notice(self, session: AgentSession, data: Buffer, now_ns: int) -> str | None:
        """The server does not know our session, or somebody says so in its name: find out by a new hello.

        A server that is there is heard before the hello is due, which is then not sent. The session goes on
        until a welcome replaces it, or the server's silence ends it.
        """
        if len(data) != PREFIX_SIZE:
            return "malformed"
        if self._handshake is None:
            self._say_hello(max(now_ns, session.heard_ns + DOUBT_NS) if session.confirmed else now_ns)
        return None

    def _receive_body(self, session: AgentSession, message_type: int, body: bytes, now_ns: int) -> str | None:
        try:
            message = decode_body(message_type, body)
        except DataError:
            return "malformed"
        self._confirm(session)
        match message:
            case ClockRequest():
                session.take_clock_request(message, now_ns)
            case Resend():
                session.take_resend(message)
            case StreamPlan():
                self.plan = message
            case Goodbye(text):
                self._lose(f"the server said goodbye: {text}", now_ns)
        return None

    # ---- states

    def _seek(self, now_ns: int) -> None:
        """Look for the server, at once."""
        self._session, self.plan = None, None
        self._say_hello(now_ns)

    def _say_hello(self, due_ns: int) -> None:
        self._handshake = AgentHandshake(self._hello, self._rig_key, self._random_bytes)
        self._hello_due_ns, self._awaits_reject = due_ns, False
        self._hello_retry_ns = HELLO_RETRY_NS[0]

    def _begin(self, session: AgentSession) -> None:
        """A welcome has come: from now on its session counts."""
        if self.session is not None:
            self._events.append(Disconnected("the server was restarted, or took another agent meanwhile"))
        self._session, self.plan = session, None
        self._handshake = None
        self._refused_retry_ns = REFUSED_RETRY_NS[0]

    def _confirm(self, session: AgentSession) -> None:
        """A sealed message of our session has come: the server is there, whatever a notice said."""
        self._handshake = None
        if not session.confirmed:
            session.confirmed = True
            self.counters.sessions += 1
            self._events.append(Connected(session.welcome))

    def _refused(self, message: object, now_ns: int) -> None:
        if not isinstance(message, Reject):
            return
        self._awaits_reject = False
        self._hello_due_ns = now_ns + self._refused_retry_ns
        self._refused_retry_ns = min(2 * self._refused_retry_ns, REFUSED_RETRY_NS[1])
        self.counters.rejects += 1
        self._events.append(Rejected(message.reason, message.text))

    def _lose(self, text: str, now_ns: int) -> None:
        was_connected = self.connected
        self._seek(now_ns)
        if was_connected:
            self._events.append(Disconnected(text))

    def _hello_if_due(self, now_ns: int) -> list[bytes]:
        if self._handshake is None or not is_due(self._hello_due_ns, now_ns, REFUSED_RETRY_NS[1]):
            return []
        self._hello_due_ns = now_ns + self._hello_retry_ns
        self._hello_retry_ns = min(2 * self._hello_retry_ns, HELLO_RETRY_NS[1])
        self.counters.hellos += 1
        self._awaits_reject = True
        return [self._handshake.datagram]


def _check(prefix: Prefix, data: Buffer) -> str | None:
    """Why a datagram is none that a server of our version sends, or None."""
    if prefix.magic != MAGIC:
        return "bad_magic"
    if prefix.version != VERSION and prefix.type != MessageType.REJECT:
        return "other_version"
    if prefix.type not in _FROM_SERVER:
        return "unexpected_type" if prefix.type in _ASSIGNED else "unknown_type"
    if len(data) > MAX_CONTROL_SIZE:
        return "malformed"
    if prefix.type not in _SEALED and prefix.crc != clear_crc(data):
        return "corrupt_control"
    return None
