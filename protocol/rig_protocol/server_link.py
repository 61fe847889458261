"""The server's end of the protocol: datagrams of every agent in, events and answers out. No I/O.

The shell feeds `receive_batch`, sends `datagrams_to_send`, calls `handle_timeout` when `next_timeout_ns`
is due, and fetches `next_event` until None. Rules: protocol/SPEC.md, sections 6 and 9.
"""

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

from rig_protocol.admission import (
    choose_codecs,
    duplicate_slot,
    gives_way,
    malformed_hello,
    same_agent,
    version_mismatch,
)
from rig_protocol.datagram import (
    DEFAULT_DATAGRAM_SIZE,
    FRAGMENT_PREFIX,
    MAGIC,
    MAX_DATAGRAM_SIZE,
    MIN_DATAGRAM_SIZE,
    VERSION,
    Buffer,
    DatagramBatch,
    MessageType,
    Prefix,
    consecutive_runs,
    parse_fragment_header,
    parse_prefix,
)
from rig_protocol.errors import DataError, LinkUsageError
from rig_protocol.event_queue import EventQueue
from rig_protocol.events import (
    Address,
    CameraJoined,
    CameraLeft,
    FrameReceived,
    HelloRefused,
    ServerEvent,
)
from rig_protocol.message_bytes import (
    MIN_HELLO_SIZE,
    control_crc,
    decode_hello,
    decode_message,
    encode_message,
)
from rig_protocol.messages import (
    ClockReply,
    Goodbye,
    Heartbeat,
    Hello,
    Message,
    Reject,
    UnknownSession,
    Welcome,
)
from rig_protocol.rate_limit import RateLimit
from rig_protocol.roster import Roster
from rig_protocol.server_session import CameraStatus, ServerSession

# A copy of a hello does not outlive that many sessions of its slot.
_MAX_NONCES = 8
_NOTICE_INTERVAL_NS = 100_000_000  # to one address
_NOTICE_INTERVAL_ALL_NS = 5_000_000
_REFUSAL_EVENT_INTERVAL_NS = 1_000_000_000
# Answers wait for one turn of the shell; a flood of hellos beyond this loses its oldest answers.
_MAX_OUTGOING = 1024
_ASSIGNED = frozenset(MessageType)
_FROM_AGENT = frozenset({MessageType.GOODBYE, MessageType.HEARTBEAT, MessageType.CLOCK_REPLY})


class ServerLink:
    """All agents' sessions on one port."""

    def __init__(
        self,
        roster: Roster,
        session_id_source: Callable[[], int],
        color_codecs: Sequence[int],
        depth_codecs: Sequence[int],
        datagram_size: int = DEFAULT_DATAGRAM_SIZE,
    ) -> None:
        """`session_id_source` yields unguessable 64-bit numbers; the codecs are those the server decodes."""
        if not MIN_DATAGRAM_SIZE <= datagram_size <= MAX_DATAGRAM_SIZE:
            raise LinkUsageError(
                f"datagram size {datagram_size} is not in {MIN_DATAGRAM_SIZE}..{MAX_DATAGRAM_SIZE}"
            )
        self.rejected: Counter[str] = Counter()
        self._roster = roster
        self._session_id_source = session_id_source
        self._color_codecs, self._depth_codecs = tuple(color_codecs), tuple(depth_codecs)
        self._datagram_size = datagram_size
        self._closed = False
        self._statuses: dict[int, CameraStatus] = {}
        self._sessions: dict[int, ServerSession] = {}  # by session id
        self._nonces: dict[int, deque[int]] = {}  # of accepted hellos, by camera id
        self._events = EventQueue()
        self._outgoing: deque[tuple[bytes, Address]] = deque(maxlen=_MAX_OUTGOING)
        self._notices = RateLimit(_NOTICE_INTERVAL_NS)
        self._all_notices = RateLimit(_NOTICE_INTERVAL_ALL_NS, max_keys=1)
        self._refusal_events = RateLimit(_REFUSAL_EVENT_INTERVAL_NS)

    @property
    def cameras(self) -> Mapping[int, CameraStatus]:
        """Every camera that was here since the start, by id; a live view."""
        return MappingProxyType(self._statuses)

    def receive_batch(self, batch: DatagramBatch, address: Address, now_ns: int) -> None:
        """Take datagrams of one sender; the buffer may be reused after the call."""
        if 0 < len(batch.buffer) <= batch.segment_size:
            self._receive(batch.buffer, address, now_ns)
            return
        for count, run in consecutive_runs(batch):
            if run[:4] == FRAGMENT_PREFIX:
                self._receive_fragments(run, count, address, now_ns)
            else:
                for datagram in DatagramBatch(run, batch.segment_size):
                    self._receive(datagram, address, now_ns)

    def receive_datagram(self, data: Buffer, address: Address, now_ns: int) -> None:
        """Take one datagram."""
        self._receive(data, address, now_ns)

    def datagrams_to_send(self, now_ns: int) -> list[tuple[bytes, Address]]:
        """Everything to transmit now; clock requests are stamped with `now_ns`."""
        for session in self._sessions.values():
            request = session.clock_request(now_ns)
            if request is not None:
                self._send(request, session.welcome.session_id, session.address)
        datagrams = list(self._outgoing)
        self._outgoing.clear()
        return datagrams

    def next_timeout_ns(self) -> int | None:
        """When to call `handle_timeout` and `datagrams_to_send` next; None while nobody is connected."""
        return min((session.next_timeout_ns for session in self._sessions.values()), default=None)

    def handle_timeout(self, now_ns: int) -> None:
        """Give up late frames and silent agents."""
        for session in list(self._sessions.values()):
            session.expire(now_ns)
            if session.silent(now_ns):
                silence_s = (now_ns - session.last_heard_ns) / 1e9
                self._end(session, f"silent for {silence_s:.1f} s")

    def next_event(self) -> ServerEvent | None:
        """The oldest event that was not fetched yet, or None."""
        return self._events.pop()

    def close(self, now_ns: int) -> None:  # noqa: ARG002  # the verbs of both links take the time
        """End every session with a goodbye, to be fetched with `datagrams_to_send`; welcome nobody after."""
        self._closed = True
        for session in list(self._sessions.values()):
            self._send(Goodbye("the server stops"), session.welcome.session_id, session.address)
            self._end(session, "the server stops")

    # ---- dispatch

    def _receive(self, datagram: Buffer, address: Address, now_ns: int) -> None:
        if datagram[:4] == FRAGMENT_PREFIX:
            self._receive_fragments(datagram, 1, address, now_ns)
            return
        prefix = parse_prefix(datagram)
        if prefix is None:
            self.rejected["too_short"] += 1
        elif prefix.magic != MAGIC:
            self.rejected["bad_magic"] += 1
        elif prefix.type == MessageType.HELLO:
            self._receive_hello(prefix, datagram, address, now_ns)
        elif prefix.version != VERSION:
            self.rejected["other_version"] += 1
        elif prefix.type not in _FROM_AGENT:
            self.rejected["unexpected_type" if prefix.type in _ASSIGNED else "unknown_type"] += 1
        elif prefix.crc != control_crc(datagram):
            self.rejected["corrupt_control"] += 1
        else:
            self._receive_control(prefix, datagram, address, now_ns)

    def _receive_fragments(self, run: Buffer, count: int, address: Address, now_ns: int) -> None:
        header = parse_fragment_header(run)
        if header is None:
            self.rejected["bad_fragment"] += count
            return
        session = self._session_of(header.session_id, count, address, now_ns)
        if session is None:
            return
        session.status.counters.bytes += len(run)
        frame = session.receive_fragments(header, run, count, now_ns)
        if frame is not None:
            self._push(FrameReceived(frame))

    def _receive_control(self, prefix: Prefix, datagram: Buffer, address: Address, now_ns: int) -> None:
        session = self._session_of(prefix.id, 1, address, now_ns)
        if session is None:
            return
        try:
            message = decode_message(prefix, datagram)
        except DataError:
            self.rejected["malformed"] += 1
            return
        match message:
            case Heartbeat(health):
                session.status.health = health
            case ClockReply():
                session.receive_clock_reply(message, now_ns)
            case Goodbye(text):
                self._end(session, f"goodbye: {text}")

    def _session_of(self, session_id: int, count: int, address: Address, now_ns: int) -> ServerSession | None:
        """The session of a datagram, now heard; None (counted, answered) when there is none."""
        session = self._sessions.get(session_id)
        if session is None:
            self.rejected["unknown_session"] += count
            if self._notices.allows(address, now_ns) and self._all_notices.allows("all", now_ns):
                self._send(UnknownSession(), session_id, address)
            return None
        if session.address != address:
            self.rejected["wrong_address"] += count
            return None
        session.last_heard_ns = now_ns
        return session

    # ---- sessions

    def _receive_hello(self, prefix: Prefix, datagram: Buffer, address: Address, now_ns: int) -> None:
        if self._closed:
            self.rejected["closed"] += 1
        elif len(datagram) < MIN_HELLO_SIZE or prefix.id == 0:
            self.rejected["malformed"] += 1
        elif prefix.crc != control_crc(datagram):
            self.rejected["corrupt_control"] += 1
        elif prefix.version != VERSION:
            self._refuse(version_mismatch(prefix.version), prefix.id, address, now_ns)
        else:
            refusal = self._take_hello(prefix, datagram, address, now_ns)
            if refusal is not None:
                self._refuse(refusal, prefix.id, address, now_ns)

    def _take_hello(self, prefix: Prefix, datagram: Buffer, address: Address, now_ns: int) -> Reject | None:
        """Welcome a camera, or say why not."""
        try:
            hello = decode_hello(prefix, datagram)
        except DataError as error:
            return malformed_hello(error)
        camera_id = self._roster.assign(hello, self._recall(hello, address), self._taken(hello, address))
        if isinstance(camera_id, Reject):
            return camera_id
        holder = self._holder(camera_id)
        if prefix.id in self._nonces.get(camera_id, ()):
            self._answer_copy(holder, prefix.id, address)
            return None
        if holder is not None and not gives_way(holder, hello, address, now_ns):
            return duplicate_slot(holder, hello, now_ns)
        codecs = choose_codecs(hello, self._color_codecs, self._depth_codecs)
        if isinstance(codecs, Reject):
            return codecs
        if holder is not None:
            self._end(holder, "replaced by a new session")
        welcome = Welcome(self._new_session_id(), camera_id, *codecs, self._datagram_size)
        self._begin(welcome, hello, prefix.id, address, now_ns)
        return None

    def _begin(self, welcome: Welcome, hello: Hello, nonce: int, address: Address, now_ns: int) -> None:
        status = self._statuses.get(welcome.camera_id)
        if status is None:
            status = CameraStatus(welcome.camera_id, hello.name, address, hello)
            self._statuses[welcome.camera_id] = status
        status.joined(hello, address)
        self._nonces.setdefault(welcome.camera_id, deque(maxlen=_MAX_NONCES)).append(nonce)
        self._sessions[welcome.session_id] = ServerSession(status, nonce, welcome, now_ns)
        self._send(welcome, nonce, address)
        self._push(CameraJoined(welcome.camera_id, hello, address))

    def _end(self, session: ServerSession, text: str) -> None:
        del self._sessions[session.welcome.session_id]
        session.close()
        self._push(CameraLeft(session.welcome.camera_id, text))

    def _answer_copy(self, holder: ServerSession | None, nonce: int, address: Address) -> None:
        """A hello came again: our answer to it was lost, or it is a late copy of an old one."""
        if holder is not None and holder.hello_nonce == nonce and holder.address == address:
            self._send(holder.welcome, nonce, address)
        else:
            self.rejected["stale_hello"] += 1

    def _refuse(self, reject: Reject, nonce: int, address: Address, now_ns: int) -> None:
        self.rejected[f"refused_{reject.reason.name.lower()}"] += 1
        self._send(reject, nonce, address)
        if self._refusal_events.allows(address, now_ns):
            self._push(HelloRefused(address, reject.reason, reject.text))

    def _holder(self, camera_id: int) -> ServerSession | None:
        return next((s for s in self._sessions.values() if s.welcome.camera_id == camera_id), None)

    def _recall(self, hello: Hello, address: Address) -> int | None:
        """The id that this camera had before."""
        same = (i for i, status in self._statuses.items() if same_agent(status, hello, address))
        return next(same, None)

    def _taken(self, hello: Hello, address: Address) -> set[int]:
        """Ids that other live cameras hold."""
        others = (s for s in self._sessions.values() if not same_agent(s.status, hello, address))
        return {session.welcome.camera_id for session in others}

    def _new_session_id(self) -> int:
        while True:
            session_id = self._session_id_source()
            if session_id and session_id not in self._sessions:
                return session_id

    # ---- out

    def _send(self, message: Message, id_: int, address: Address) -> None:
        self._outgoing.append((encode_message(message, id_), address))

    def _push(self, event: ServerEvent) -> None:
        dropped = self._events.push(event)
        if isinstance(dropped, FrameReceived):
            self._statuses[dropped.frame.camera_id].counters.overflow += 1
        elif dropped is not None:
            self.rejected["event_overflow"] += 1
