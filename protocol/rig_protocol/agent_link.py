"""The agent's end of the protocol: one server, one camera. No I/O.

The shell feeds `receive_datagram`, sends `datagrams_to_send`, calls `handle_timeout` when
`next_timeout_ns` is due, fetches `next_event` until None, and hands frames to `send_frame`.
Rules: protocol/SPEC.md, sections 6 and 9.
"""

from collections import deque
from collections.abc import Callable, Mapping

from rig_protocol.counters import AgentCounters
from rig_protocol.datagram import (
    DEFAULT_DATAGRAM_SIZE,
    MAGIC,
    MAX_DATAGRAM_SIZE,
    MIN_DATAGRAM_SIZE,
    VERSION,
    Buffer,
    DatagramBatch,
    MessageType,
    Prefix,
    parse_prefix,
)
from rig_protocol.errors import DataError, LinkUsageError
from rig_protocol.events import AgentEvent, Connected, Disconnected, Rejected
from rig_protocol.fragmenter import fragment
from rig_protocol.frames import EncodedFrame
from rig_protocol.message_bytes import control_crc, decode_message, encode_message
from rig_protocol.messages import (
    ClockReply,
    ClockRequest,
    Goodbye,
    Heartbeat,
    Hello,
    Message,
    Reject,
    UnknownSession,
    Welcome,
)

HEARTBEAT_INTERVAL_NS = 500_000_000
SILENCE_NS = 2_000_000_000
# A server that is starting is met within a second; one that refuses needs a person first.
HELLO_RETRY_NS = (100_000_000, 1_000_000_000)
REFUSED_RETRY_NS = (500_000_000, 5_000_000_000)
# The server sends eight requests in a row; each is answered at the next turn of the shell.
_MAX_CLOCK_REQUESTS = 16
# Events come at the pace of hellos: an owner that never fetches loses the oldest.
_MAX_EVENTS = 64

_ANSWERS = frozenset({MessageType.WELCOME, MessageType.REJECT})
_FROM_SERVER = _ANSWERS | {MessageType.GOODBYE, MessageType.CLOCK_REQUEST, MessageType.UNKNOWN_SESSION}
_ASSIGNED = frozenset(MessageType)


class AgentLink:
    """Says hello until welcome, keeps the session alive, answers clock requests, cuts up frames."""

    def __init__(
        self, hello: Hello, datagram_size: int = DEFAULT_DATAGRAM_SIZE, *, nonce_source: Callable[[], int]
    ) -> None:
        """`nonce_source` yields unguessable 64-bit numbers; LinkUsageError for a hello against the limits."""
        if not MIN_DATAGRAM_SIZE <= datagram_size <= MAX_DATAGRAM_SIZE:
            raise LinkUsageError(
                f"datagram size {datagram_size} is not in {MIN_DATAGRAM_SIZE}..{MAX_DATAGRAM_SIZE}"
            )
        encode_message(hello, 1)  # raises where it cannot be sent
        self.counters = AgentCounters()
        self.session: Welcome | None = None
        self._hello = hello
        self._datagram_size = datagram_size
        self._nonce_source = nonce_source
        self._closed = False
        self._heard_ns = 0
        self._heartbeat_due_ns = 0
        self._health: Mapping[str, float] = {}
        self._frame_number = 0
        self._clock_requests: deque[tuple[ClockRequest, int]] = deque(maxlen=_MAX_CLOCK_REQUESTS)
        self._goodbye: bytes | None = None
        self._events: deque[AgentEvent] = deque(maxlen=_MAX_EVENTS)
        self._refused_retry_ns = REFUSED_RETRY_NS[0]
        self._seek(0)

    @property
    def connected(self) -> bool:
        """True between welcome and the end of the session."""
        return self.session is not None

    def receive_datagram(self, data: Buffer, now_ns: int) -> None:
        """Take one datagram of the server."""
        prefix = parse_prefix(data)
        cause = "too_short" if prefix is None else self._receive(prefix, data, now_ns)
        if cause is not None:
            self.counters.rejected[cause] += 1

    def datagrams_to_send(self, now_ns: int) -> list[bytes]:
        """Control datagrams to transmit now; clock replies are stamped with `now_ns`."""
        if self._goodbye is not None:
            goodbye, self._goodbye = self._goodbye, None
            return [goodbye]
        if self._closed:
            return []
        if self.session is None:
            return self._hello_if_due(now_ns)
        datagrams = [
            encode_message(ClockReply(request.t1_ns, received_ns, now_ns), self.session.session_id)
            for request, received_ns in self._clock_requests
        ]
        self._clock_requests.clear()
        if _is_due(self._heartbeat_due_ns, now_ns, HEARTBEAT_INTERVAL_NS):
            self._heartbeat_due_ns = now_ns + HEARTBEAT_INTERVAL_NS
            datagrams.append(encode_message(Heartbeat(self._health), self.session.session_id))
        return datagrams

    def next_timeout_ns(self) -> int | None:
        """When to call `handle_timeout` and `datagrams_to_send` next; None when closed."""
        if self._closed:
            return None
        if self.session is None:
            return self._hello_due_ns
        return min(self._heartbeat_due_ns, self._heard_ns + SILENCE_NS)

    def handle_timeout(self, now_ns: int) -> None:
        """Notice a server that fell silent."""
        if self.session is not None and now_ns - self._heard_ns >= SILENCE_NS:
            self._lose(f"the server has been silent for {(now_ns - self._heard_ns) / 1e9:.1f} s", now_ns)

    def next_event(self) -> AgentEvent | None:
        """The oldest event that was not fetched yet, or None."""
        return self._events.popleft() if self._events else None

    def send_frame(self, frame: EncodedFrame, now_ns: int) -> DatagramBatch | None:  # noqa: ARG002
        """The datagrams of a frame stamped in agent time; None (counted) where no session can take it.

        LinkUsageError for a frame over the protocol's limits.
        """
        if self.session is None:
            self.counters.not_connected += 1
            return None
        if not self.session.allows(frame):
            self.counters.unexpected_codec += 1
            return None
        size = min(self._datagram_size, self.session.datagram_size)
        batch = fragment(frame, self.session.session_id, size, self._frame_number)
        self._frame_number += 1
        self.counters.frames += 1
        self.counters.fragments += len(batch)
        self.counters.bytes += batch.total_bytes
        return batch

    def report_health(self, health: Mapping[str, float]) -> None:
        """What the next heartbeats tell the operator: at most 16 gauges by name; LinkUsageError otherwise."""
        encode_message(Heartbeat(health), 1)  # raises where it cannot be sent
        self._health = dict(health)

    def close(self, now_ns: int) -> None:  # noqa: ARG002  # the verbs of both links take the time
        """End the session with a goodbye, to be fetched with `datagrams_to_send`; nothing follows."""
        if self.session is not None:
            self._goodbye = encode_message(Goodbye("the agent stops"), self.session.session_id)
        self._closed, self.session = True, None

    # ---- dispatch: each returns the name of the cause for which a datagram was dropped

    def _receive(self, prefix: Prefix, data: Buffer, now_ns: int) -> str | None:
        cause = _check(prefix, data) or self._check_id(prefix)
        if cause is not None:
            return cause
        try:
            message = decode_message(prefix, data)
        except DataError:
            return "malformed"
        self._heard_ns = now_ns
        self._take(message, now_ns)
        return None

    def _check_id(self, prefix: Prefix) -> str | None:
        if prefix.type in _ANSWERS:
            awaited = not self._closed and self.session is None
            return None if awaited and prefix.id == self._nonce else "stale_answer"
        ours = self.session is not None and prefix.id == self.session.session_id
        return None if ours else "unknown_session"

    def _take(self, message: Message, now_ns: int) -> None:
        match message:
            case Welcome():
                self._connect(message, now_ns)
            case Reject():
                self._hello_due_ns = now_ns + self._refused_retry_ns
                self._refused_retry_ns = min(2 * self._refused_retry_ns, REFUSED_RETRY_NS[1])
                self.counters.rejects += 1
                self._events.append(Rejected(message.reason, message.text))
            case ClockRequest():
                self._clock_requests.append((message, now_ns))
            case Goodbye(text):
                self._lose(f"the server said goodbye: {text}", now_ns)
            case UnknownSession():
                self._lose(
                    "the server does not know this session: it was restarted, or took another agent", now_ns
                )

    # ---- states

    def _seek(self, now_ns: int) -> None:
        """Look for the server, at once."""
        self.session = None
        self._clock_requests.clear()
        self._nonce = self._new_nonce()
        self._hello_due_ns = now_ns
        self._hello_retry_ns = HELLO_RETRY_NS[0]

    def _connect(self, welcome: Welcome, now_ns: int) -> None:
        self.session = welcome
        self._refused_retry_ns = REFUSED_RETRY_NS[0]
        self._heartbeat_due_ns = now_ns
        self._frame_number = 0
        self.counters.sessions += 1
        self._events.append(Connected(welcome))

    def _lose(self, text: str, now_ns: int) -> None:
        self._seek(now_ns)
        self._events.append(Disconnected(text))

    def _hello_if_due(self, now_ns: int) -> list[bytes]:
        if not _is_due(self._hello_due_ns, now_ns, REFUSED_RETRY_NS[1]):
            return []
        self._hello_due_ns = now_ns + self._hello_retry_ns
        self._hello_retry_ns = min(2 * self._hello_retry_ns, HELLO_RETRY_NS[1])
        self.counters.hellos += 1
        return [encode_message(self._hello, self._nonce)]

    def _new_nonce(self) -> int:
        while True:
            nonce = self._nonce_source()
            if nonce:
                return nonce


def _is_due(due_ns: int, now_ns: int, longest_wait_ns: int) -> bool:
    """True at `due_ns`, and when the clock jumped back so far that it could not be that long."""
    return now_ns >= due_ns or due_ns - now_ns > longest_wait_ns


def _check(prefix: Prefix, data: Buffer) -> str | None:
    """Why a datagram is none that a server of our version sends, or None."""
    if prefix.magic != MAGIC:
        return "bad_magic"
    if prefix.version != VERSION and prefix.type != MessageType.REJECT:
        return "other_version"
    if prefix.type not in _FROM_SERVER:
        return "unexpected_type" if prefix.type in _ASSIGNED else "unknown_type"
    return None if prefix.crc == control_crc(data) else "corrupt_control"
