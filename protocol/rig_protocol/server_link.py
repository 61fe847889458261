"""The server's end of the protocol: datagrams of every agent in, events and answers out. No I/O.

The shell feeds `receive_batch`, sends `datagrams_to_send`, calls `handle_timeout` when `next_timeout_ns`
is due, and fetches `next_event` until None. Rules: protocol/SPEC.md, sections 6 and 9.
"""

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from types import MappingProxyType

from rig_protocol.admission import (
    choose_codecs,
    duplicate_slot,
    gives_way,
    malformed_hello,
    same_agent,
    version_mismatch,
    wrong_key,
)
from rig_protocol.clear_datagram import clear_crc, encode_clear
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
from rig_protocol.handshake import NotAuthentic, answer_hello, fresh_id, open_hello
from rig_protocol.message_bytes import MAX_CONTROL_SIZE, MIN_HELLO_SIZE, decode_body, encode_body
from rig_protocol.messages import (
    ClockReply,
    Goodbye,
    Heartbeat,
    Hello,
    Message,
    Reject,
    StreamChoice,
    UnknownSession,
    Welcome,
)
from rig_protocol.pending_sessions import PendingSession, PendingSessions
from rig_protocol.rate_limit import RateLimit
from rig_protocol.resend_budget import ResendBudget
from rig_protocol.rig_key import RigKey
from rig_protocol.roster import Roster
from rig_protocol.sealed_channel import SealedChannel
from rig_protocol.security import RandomBytes
from rig_protocol.server_session import CameraStatus, ServerSession
from rig_protocol.system_clock import SystemClockReading

_NOTICE_INTERVAL_NS = 100_000_000  # to one address
_NOTICE_INTERVAL_ALL_NS = 5_000_000
# A rig clock that reads so much less than before has been set back: no time of a session means anything.
_BACKWARD_STEP_NS = 1_000_000_000
# A key agreement costs 0.1 ms: so many a second are 1 % of a core.
_HANDSHAKE_INTERVAL_NS = 10_000_000
# Agents that lost their server in the same moment ask for it in step: all of them are to be answered at once.
_HANDSHAKE_BURST = 64
_REFUSAL_EVENT_INTERVAL_NS = 1_000_000_000
# Answers wait for one turn of the shell; a flood of hellos beyond this loses its oldest answers.
_MAX_OUTGOING = 1024
_ASSIGNED = frozenset(MessageType)
_SEALED = frozenset({MessageType.GOODBYE, MessageType.HEARTBEAT, MessageType.CLOCK_REPLY})


class ServerLink:
    """All agents' sessions on one port."""

    def __init__(
        self,
        roster: Roster,
        rig_key: RigKey,
        random_bytes: RandomBytes,
        color_codecs: Sequence[int],
        depth_codecs: Sequence[int],
        datagram_size: int = DEFAULT_DATAGRAM_SIZE,
    ) -> None:
        """`random_bytes` is an unguessable source; the codecs are those that the server decodes."""
        if not MIN_DATAGRAM_SIZE <= datagram_size <= MAX_DATAGRAM_SIZE:
            raise LinkUsageError(
                f"datagram size {datagram_size} is not in {MIN_DATAGRAM_SIZE}..{MAX_DATAGRAM_SIZE}"
            )
        self.rejected: Counter[str] = Counter()
        self.system_clock: SystemClockReading | None = None
        """What the server machine's system clock is worth, set by the shell every second or so."""
        self._roster = roster
        self._rig_key, self._random_bytes = rig_key, random_bytes
        self._color_codecs, self._depth_codecs = tuple(color_codecs), tuple(depth_codecs)
        self._datagram_size = datagram_size
        self._closed = False
        self._statuses: dict[int, CameraStatus] = {}
        self._sessions: dict[int, ServerSession] = {}  # by session id
        self._resend_budget = ResendBudget()
        self._pending = PendingSessions()
        self._clock_due: list[ServerSession] = []
        self._latest_ns = 0
        self._due_ns: int | None = None  # never later than what is due; None: nobody is connected
        self._events = EventQueue()
        self._outgoing: deque[tuple[bytes, Address]] = deque(maxlen=_MAX_OUTGOING)
        self._notices = RateLimit(_NOTICE_INTERVAL_NS)
        self._all_notices = RateLimit(_NOTICE_INTERVAL_ALL_NS, max_keys=1)
        self._handshakes = RateLimit(_HANDSHAKE_INTERVAL_NS, max_keys=1, burst=_HANDSHAKE_BURST)
        self._refusal_events = RateLimit(_REFUSAL_EVENT_INTERVAL_NS)

    @property
    def authenticated(self) -> bool:
        """True where only who holds a secret key may join."""
        return not self._rig_key.is_public

    @property
    def cameras(self) -> Mapping[int, CameraStatus]:
        """Every camera that was here since the start, by id; a live view."""
        return MappingProxyType(self._statuses)

    def receive_batch(self, batch: DatagramBatch, address: Address, now_ns: int) -> None:
        """Take datagrams of one sender; the buffer may be reused after the call."""
        self._check_clock(now_ns)
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
        self._check_clock(now_ns)
        self._receive(data, address, now_ns)

    def datagrams_to_send(self, now_ns: int) -> list[tuple[bytes, Address]]:
        """Everything to transmit now; clock requests that `handle_timeout` found due are stamped `now_ns`."""
        for session in self._clock_due:
            for datagram in session.periodic_messages(now_ns):
                self._outgoing.append((datagram, session.address))
        self._clock_due.clear()
        datagrams = list(self._outgoing)
        self._outgoing.clear()
        return datagrams

    def next_timeout_ns(self) -> int | None:
        """When to call `handle_timeout` and `datagrams_to_send` next; None while nobody is connected."""
        return self._due_ns

    def handle_timeout(self, now_ns: int) -> None:
        """Give up late frames and silent agents, ask for missed fragments and for the time."""
        self._clock_due.clear()
        for session in list(self._sessions.values()):
            for request in session.handle_timeout(now_ns):
                self._outgoing.append((request, session.address))
            if session.silent(now_ns):
                silence_s = (now_ns - session.last_heard_ns) / 1e9
                self._end(session, f"silent for {silence_s:.1f} s")
            elif session.due_ns <= now_ns:  # only the clock can be due again
                self._clock_due.append(session)
        self._due_ns = min((session.due_ns for session in self._sessions.values()), default=None)

    def limit_resends(self, bytes_per_s: float | None) -> None:
        """What the link has left for resends of all cameras; None: no limit."""
        self._resend_budget.limit(bytes_per_s)

    def plan_stream(self, camera_id: int, choice: StreamChoice) -> None:
        """What a connected camera is to send from now on; told with its next clock request.

        LinkUsageError for a choice that no plan can tell.
        """
        session = self._holder(camera_id)
        if session is not None:
            session.choose(choice)

    def next_event(self) -> ServerEvent | None:
        """The oldest event that was not fetched yet, or None."""
        return self._events.pop()

    def close(self, now_ns: int) -> None:  # noqa: ARG002  # the verbs of both links take the time
        """End every session with a goodbye, to be fetched with `datagrams_to_send`; welcome nobody after."""
        self._closed = True
        for session in list(self._sessions.values()):
            self._outgoing.append((session.seal(Goodbye("the server stops")), session.address))
            self._end(session, "the server stops")
        self._pending.clear()

    def _check_clock(self, now_ns: int) -> None:
        """Begin anew when the rig clock was set back: the agents come again within a second."""
        if now_ns < self._latest_ns - _BACKWARD_STEP_NS:
            for session in list(self._sessions.values()):
                self._outgoing.append((session.seal(Goodbye("the rig clock was set back")), session.address))
                self._end(session, "the rig clock was set back")
            self._due_ns = None
        self._latest_ns = now_ns

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
        elif prefix.type not in _SEALED:
            self.rejected["unexpected_type" if prefix.type in _ASSIGNED else "unknown_type"] += 1
        elif len(datagram) > MAX_CONTROL_SIZE:
            self.rejected["malformed"] += 1
        else:
            self._receive_sealed(prefix, datagram, address, now_ns)

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
        self._wake_at(session.due_ns)
        if frame is not None:
            self._push(FrameReceived(frame))

    def _receive_sealed(self, prefix: Prefix, datagram: Buffer, address: Address, now_ns: int) -> None:
        if prefix.id in self._pending:
            self._confirm(prefix, datagram, address, now_ns)
            return
        session = self._session_of(prefix.id, 1, address, now_ns)
        if session is None:
            return
        body = session.open(datagram, now_ns)
        if isinstance(body, str):
            self.rejected[body] += 1
            return
        self._receive_body(session, prefix.type, body, now_ns)
        self._wake_at(session.due_ns)

    def _receive_body(self, session: ServerSession, message_type: int, body: bytes, now_ns: int) -> None:
        try:
            message = decode_body(message_type, body)
        except DataError:
            self.rejected["malformed"] += 1
            return
        match message:
            case Heartbeat():
                session.receive_heartbeat(message, now_ns)
            case ClockReply():
                for frame in session.receive_clock_reply(message, self.system_clock, now_ns):
                    self._push(FrameReceived(frame))
            case Goodbye(text):
                self._end(session, f"goodbye: {text}")

    def _session_of(self, session_id: int, count: int, address: Address, now_ns: int) -> ServerSession | None:
        """The session of a datagram; None (counted, answered) when there is none."""
        session = self._sessions.get(session_id)
        if session is None:
            self.rejected["unknown_session"] += count
            known = session_id in self._pending
            if (
                not known
                and self._notices.allows(address, now_ns)
                and self._all_notices.allows("all", now_ns)
            ):
                self._send_clear(UnknownSession(), session_id, address)
            return None
        if session.address != address:
            self.rejected["wrong_address"] += count
            return None
        return session

    def _wake_at(self, due_ns: int) -> None:
        if self._due_ns is None or due_ns < self._due_ns:
            self._due_ns = due_ns

    # ---- sessions

    def _receive_hello(self, prefix: Prefix, datagram: Buffer, address: Address, now_ns: int) -> None:
        if self._closed:
            self.rejected["closed"] += 1
        elif len(datagram) < MIN_HELLO_SIZE or prefix.id == 0:
            self.rejected["malformed"] += 1
        elif prefix.crc != clear_crc(datagram):
            self.rejected["corrupt_control"] += 1
        elif prefix.version != VERSION:
            self._refuse(version_mismatch(prefix.version), prefix.id, address, now_ns)
        else:
            refusal = self._take_hello(prefix, datagram, address, now_ns)
            if refusal is not None:
                self._refuse(refusal, prefix.id, address, now_ns)

    def _take_hello(self, prefix: Prefix, datagram: Buffer, address: Address, now_ns: int) -> Reject | None:
        """Answer a hello, or say why not. Nothing but a bounded table changes before the agent confirms."""
        if self._pending.was_used(prefix.id):
            self.rejected["stale_hello"] += 1  # a copy of an old one
            return None
        known = self._pending.of_hello(prefix.id, address)
        if known is not None:
            self._outgoing.append((known.welcome_datagram, address))  # our answer was lost
            return None
        try:
            hello = open_hello(datagram, prefix.id, self._rig_key)
        except NotAuthentic:
            return wrong_key(self._rig_key.is_public)
        except DataError as error:
            return malformed_hello(error)
        welcome = self._choose(hello, address, now_ns)
        if isinstance(welcome, Reject):
            return welcome
        if self._handshakes.allows("all", now_ns):
            self._answer_hello(prefix.id, datagram, hello, welcome, address)
        else:  # the agent tries again in a moment
            self.rejected["handshake_limit"] += 1
        return None

    def _choose(self, hello: Hello, address: Address, now_ns: int) -> Welcome | Reject:
        camera_id = self._roster.assign(hello, self._recall(hello, address), self._taken(hello, address))
        if isinstance(camera_id, Reject):
            return camera_id
        holder = self._holder(camera_id)
        if holder is not None and not gives_way(holder, hello, address, now_ns):
            return duplicate_slot(holder, hello, now_ns)
        codecs = choose_codecs(hello, self._color_codecs, self._depth_codecs)
        if isinstance(codecs, Reject):
            return codecs
        return Welcome(self._new_session_id(), camera_id, *codecs, self._datagram_size, hello.ciphers[0])

    def _answer_hello(
        self, nonce: int, datagram: Buffer, hello: Hello, welcome: Welcome, address: Address
    ) -> None:
        try:
            answer, agreement = answer_hello(datagram, nonce, welcome, self._rig_key, self._random_bytes)
        except DataError:
            self.rejected["malformed"] += 1
            return
        self._pending.add(PendingSession(hello, nonce, address, agreement, answer))
        self._outgoing.append((answer, address))

    def _confirm(self, prefix: Prefix, datagram: Buffer, address: Address, now_ns: int) -> None:
        """The first sealed message of a session proves that its agent is there: the session begins."""
        pending = self._pending.of_id(prefix.id)
        if pending is None or pending.address != address:
            self.rejected["wrong_address"] += 1
            return
        if isinstance(_opened(pending, datagram), str):
            self.rejected["bad_seal"] += 1
            return
        self._pending.take(prefix.id)
        holder = self._holder(pending.agreement.welcome.camera_id)
        if holder is not None and not gives_way(holder, pending.hello, address, now_ns):
            self.rejected["refused_duplicate_slot"] += 1  # another agent was quicker; the next hello is told
            return
        if holder is not None:
            self._end(holder, "replaced by a new session")
        self._begin(pending, now_ns)
        self._receive_sealed(prefix, datagram, address, now_ns)

    def _begin(self, pending: PendingSession, now_ns: int) -> None:
        welcome, hello, address = pending.agreement.welcome, pending.hello, pending.address
        status = self._statuses.get(welcome.camera_id)
        if status is None:
            status = CameraStatus(welcome.camera_id, hello.name, address, hello)
            self._statuses[welcome.camera_id] = status
        status.joined(hello, address)
        self._sessions[welcome.session_id] = ServerSession(
            status, pending.agreement, self._resend_budget, now_ns
        )
        self._wake_at(now_ns)
        self._push(CameraJoined(welcome.camera_id, hello, address))

    def _end(self, session: ServerSession, text: str) -> None:
        del self._sessions[session.welcome.session_id]
        session.close()
        self._push(CameraLeft(session.welcome.camera_id, text))

    def _refuse(self, reject: Reject, nonce: int, address: Address, now_ns: int) -> None:
        self.rejected[f"refused_{reject.reason.name.lower()}"] += 1
        if self._notices.allows(address, now_ns) and self._all_notices.allows("all", now_ns):
            self._send_clear(reject, nonce, address)
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
        while (session_id := fresh_id(self._random_bytes)) in self._sessions or session_id in self._pending:
            continue
        return session_id

    # ---- out

    def _send_clear(self, message: Message, id_: int, address: Address) -> None:
        self._outgoing.append((encode_clear(*encode_body(message), id_), address))

    def _push(self, event: ServerEvent) -> None:
        dropped = self._events.push(event)
        if isinstance(dropped, FrameReceived):
            self._statuses[dropped.frame.camera_id].counters.overflow += 1
        elif dropped is not None:
            self.rejected["event_overflow"] += 1


def _opened(pending: PendingSession, datagram: Buffer) -> bytes | str:
    """The body of a sealed datagram by the keys of a session that has not begun."""
    welcome, keys = pending.agreement.welcome, pending.agreement.keys
    channel = SealedChannel(welcome.cipher, keys.server_control, keys.agent_control, welcome.session_id)
    return channel.open(datagram)
