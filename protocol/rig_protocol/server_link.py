"""The server's end of the protocol: datagrams of every agent in, events and answers out. No I/O.

The shell feeds `receive_batch`, sends `datagrams_to_send`, calls `handle_timeout` when `next_timeout_ns`
is due, and fetches `next_event` until None. Rules: protocol/SPEC.md, sections 6 and 9.
"""

from collections import Counter, deque
from collections.abc import Mapping, Sequence

from rig_protocol.admission import Objection, gives_way
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
    ControlAnswered,
    FrameReceived,
    Outcome,
    ServerEvent,
)
from rig_protocol.message_bytes import MAX_CONTROL_SIZE, decode_body, encode_body
from rig_protocol.messages import (
    ClockReply,
    Control,
    ControlResult,
    ControlValue,
    Goodbye,
    Heartbeat,
    StreamChoice,
)
from rig_protocol.pending_sessions import PendingSession
from rig_protocol.reception import Reception, Terms
from rig_protocol.resend_budget import ResendBudget
from rig_protocol.rig_key import RigKey
from rig_protocol.roster import Roster
from rig_protocol.security import RandomBytes
from rig_protocol.server_session import CameraStatus, ServerSession
from rig_protocol.session_table import SessionTable
from rig_protocol.system_clock import SystemClockReading

# A rig clock that reads so much less than before has been set back: no time of a session means anything.
_BACKWARD_STEP_NS = 1_000_000_000
# Answers wait for one turn of the shell; a flood of hellos beyond this loses its oldest answers.
_MAX_OUTGOING = 1024
_ASSIGNED = frozenset(MessageType)
_SEALED = frozenset(
    {
        MessageType.GOODBYE,
        MessageType.HEARTBEAT,
        MessageType.CLOCK_REPLY,
        MessageType.CONTROL_RESULT,
    }
)


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
        objection: Objection = lambda *_: None,
    ) -> None:
        """`random_bytes` is an unguessable source; the codecs are those that the server decodes.

        `objection` says why a camera that the roster knows is not welcome now, or None.
        """
        if not MIN_DATAGRAM_SIZE <= datagram_size <= MAX_DATAGRAM_SIZE:
            raise LinkUsageError(
                f"datagram size {datagram_size} is not in {MIN_DATAGRAM_SIZE}..{MAX_DATAGRAM_SIZE}"
            )
        self.rejected: Counter[str] = Counter()
        self.authenticated = not rig_key.is_public
        """True where only who holds a secret key may join."""
        self.system_clock: SystemClockReading | None = None
        """What the server machine's system clock is worth, set by the shell every second or so."""
        self.rig_clock: str | None = None
        """What the shell calls the clock that it hands in, for those who tell it again later."""
        self._resend_budget = ResendBudget()
        self._sessions = SessionTable(self._resend_budget)
        self._clock_due: list[ServerSession] = []
        self._latest_ns = 0
        self._tickets = 0
        self._due_ns: int | None = None  # never later than what is due; None: nobody is connected
        self._events = EventQueue()
        self._outgoing: deque[tuple[bytes, Address]] = deque(maxlen=_MAX_OUTGOING)
        self._reception = Reception(
            roster,
            rig_key,
            random_bytes,
            Terms(tuple(color_codecs), tuple(depth_codecs), datagram_size),
            self._sessions,
            self.rejected,
            self._send,
            self._push,
            objection,
        )

    @property
    def cameras(self) -> Mapping[int, CameraStatus]:
        """Every camera that was here since the start, by id; a live view."""
        return self._sessions.statuses

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
            for datagram in session.periodic_messages(now_ns, self.rig_clock):
                self._send(datagram, session.address)
        if self._clock_due:
            self._due_ns = min((session.due_ns for session in self._sessions), default=None)
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
        for session in self._sessions:
            for request in session.handle_timeout(now_ns):
                self._send(request, session.address)
            for ticket in session.controls.given_up():
                self._tell(session, ticket, Outcome.UNANSWERED, "no answer came in time")
            if session.silent(now_ns):
                silence_s = (now_ns - session.last_heard_ns) / 1e9
                self._end(session, f"silent for {silence_s:.1f} s")
            elif session.due_ns <= now_ns:  # only the clock can be due again
                self._clock_due.append(session)
        self._due_ns = min((session.due_ns for session in self._sessions), default=None)

    def limit_resends(self, bytes_per_s: float | None) -> None:
        """What the link has left for resends of all cameras; None: no limit."""
        self._resend_budget.limit(bytes_per_s)

    def plan_stream(self, camera_id: int, choice: StreamChoice) -> None:
        """What a connected camera is to send from now on; told with its next clock request.

        LinkUsageError for a choice that no plan can tell.
        """
        session = self._sessions.of_camera(camera_id)
        if session is not None:
            session.choose(choice)

    def control(self, camera_id: int, name: str, value: ControlValue, now_ns: int) -> int:
        """Have a camera's agent set something; a ticket, of which `ControlAnswered` tells what became.

        LinkUsageError for a name or a value that no message can tell.
        """
        encode_body(Control(1, name, value))
        self._tickets += 1
        ticket, session = self._tickets, self._sessions.of_camera(camera_id)
        if session is None:
            refusal = "it is not connected"
        elif not session.welcome.controls:
            refusal = "its agent is of a release that takes no controls: upgrade it"
        elif not session.controls.ask(ticket, name, value, now_ns):
            refusal = "too many controls wait for its agent already"
        else:
            self._wake_at(now_ns)
            session.due_ns = min(session.due_ns, now_ns)
            return ticket
        self._push(ControlAnswered(camera_id, ticket, Outcome.REFUSED, refusal))
        return ticket

    @property
    def roster(self) -> Roster:
        """Who belongs to the rig; a new one holds for the hellos that come from then on."""
        return self._reception.roster

    @roster.setter
    def roster(self, roster: Roster) -> None:
        self._reception.roster = roster

    def dismiss(self, camera_id: int, why: str) -> None:
        """End a camera's session with a goodbye that says why."""
        session = self._sessions.of_camera(camera_id)
        if session is not None:
            self._send(session.seal(Goodbye(why)), session.address)
            self._end(session, why)

    def next_event(self) -> ServerEvent | None:
        """The oldest event that was not fetched yet, or None."""
        return self._events.pop()

    def close(self, now_ns: int) -> None:  # noqa: ARG002  # the verbs of both links take the time
        """End every session with a goodbye, to be fetched with `datagrams_to_send`; welcome nobody after."""
        self._reception.close()
        self._end_all("the server stops")

    def _check_clock(self, now_ns: int) -> None:
        """Begin anew when the rig clock was set back: the agents come again within a second."""
        if now_ns < self._latest_ns - _BACKWARD_STEP_NS:
            self._end_all("the rig clock was set back")
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
            self._reception.receive_hello(prefix, datagram, address, now_ns)
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
        if prefix.id in self._reception:
            pending = self._reception.confirm(prefix.id, datagram, address, now_ns)
            if pending is None or not self._begin(pending, now_ns):
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
            case ControlResult():
                self._receive_result(session, message, now_ns)
            case Goodbye(text):
                self._end(session, f"goodbye: {text}")

    def _receive_result(self, session: ServerSession, result: ControlResult, now_ns: int) -> None:
        ticket = session.controls.take_result(result, now_ns)
        if ticket is None:  # a copy, or one that comes after we gave up waiting
            self.rejected["stale_result"] += 1
        else:
            self._tell(session, ticket, Outcome.DONE if result.done else Outcome.REFUSED, result.text)
        session.due_ns = min(session.due_ns, session.controls.due_ns)

    def _tell(self, session: ServerSession, ticket: int, outcome: Outcome, text: str) -> None:
        self._push(ControlAnswered(session.welcome.camera_id, ticket, outcome, text))

    def _session_of(self, session_id: int, count: int, address: Address, now_ns: int) -> ServerSession | None:
        """The session of a datagram; None (counted, answered) when there is none."""
        session = self._sessions.of_id(session_id)
        if session is None:
            self.rejected["unknown_session"] += count
            self._reception.notify_unknown(session_id, address, now_ns)
            return None
        if session.address != address:
            self.rejected["wrong_address"] += count
            return None
        return session

    def _wake_at(self, due_ns: int) -> None:
        if self._due_ns is None or due_ns < self._due_ns:
            self._due_ns = due_ns

    # ---- sessions

    def _begin(self, pending: PendingSession, now_ns: int) -> bool:
        """Begin the session of an agent that has proved to be there; False where another was quicker."""
        camera_id, address = pending.agreement.welcome.camera_id, pending.address
        holder = self._sessions.of_camera(camera_id)
        if holder is not None and not gives_way(holder, pending.hello, address, now_ns):
            self.rejected["refused_duplicate_slot"] += 1  # its next hello is told
            return False
        if holder is not None:
            self._end(holder, "replaced by a new session")
        self._sessions.begin(pending, now_ns)
        self._wake_at(now_ns)
        self._push(CameraJoined(camera_id, pending.hello, address))
        return True

    def _end(self, session: ServerSession, text: str) -> None:
        self._sessions.end(session)
        for ticket in session.controls.close():
            self._tell(session, ticket, Outcome.UNANSWERED, f"its session ended: {text}")
        self._push(CameraLeft(session.welcome.camera_id, text))

    def _end_all(self, text: str) -> None:
        for session in self._sessions:
            self._send(session.seal(Goodbye(text)), session.address)
            self._end(session, text)

    # ---- out

    def _send(self, datagram: bytes, address: Address) -> None:
        self._outgoing.append((datagram, address))

    def _push(self, event: ServerEvent) -> None:
        dropped = self._events.push(event)
        if isinstance(dropped, FrameReceived):
            self.cameras[dropped.frame.camera_id].counters.overflow += 1
        elif dropped is not None:
            self.rejected["event_overflow"] += 1
