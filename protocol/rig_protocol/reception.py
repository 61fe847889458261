"""The server towards those who have no session: hellos, refusals, notices, and who may begin one.

Rules: protocol/SPEC.md, sections 5 and 6.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from rig_protocol.admission import (
    Objection,
    choose_codecs,
    duplicate_slot,
    gives_way,
    malformed_hello,
    no_room,
    version_mismatch,
    wrong_key,
)
from rig_protocol.clear_datagram import clear_crc, encode_clear
from rig_protocol.datagram import MAX_DATAGRAM_SIZE, VERSION, Buffer, Prefix
from rig_protocol.errors import DataError
from rig_protocol.events import Address, HelloRefused
from rig_protocol.handshake import NotAuthentic, answer_hello, fresh_id, open_hello
from rig_protocol.message_bytes import MAX_CONTROL_SIZE, MIN_HELLO_SIZE, decode_hello, encode_body
from rig_protocol.messages import Hello, Reject, UnknownSession, Welcome
from rig_protocol.pending_sessions import PendingSession, PendingSessions
from rig_protocol.rate_limit import RateLimit
from rig_protocol.rig_key import RigKey
from rig_protocol.roster import Roster
from rig_protocol.sealed_channel import SealedChannel
from rig_protocol.security import RandomBytes
from rig_protocol.session_table import SessionTable

_NOTICE_INTERVAL_NS = 100_000_000  # to one address
_NOTICE_INTERVAL_ALL_NS = 5_000_000
# A key agreement costs 0.1 ms: so many a second are 1 % of a core.
_HANDSHAKE_INTERVAL_NS = 10_000_000
# Agents that lost their server in the same moment ask for it in step: all of them are to be answered at once.
_HANDSHAKE_BURST = 64
_REFUSAL_EVENT_INTERVAL_NS = 1_000_000_000  # of one host
# Of all hosts: the owner writes a log line for each, and a stranger has as many ports as he likes.
_ALL_REFUSAL_EVENTS_INTERVAL_NS = 200_000_000
_ALL_REFUSAL_EVENTS_BURST = 16
# An agent whose first heartbeats are lost gives up after two seconds of silence, and says hello anew.
_OFFER_LIFE_NS = 3_000_000_000
# Of one hello: an agent repeats it after 100 ms at the earliest.
_REPEAT_INTERVAL_NS = 50_000_000


@dataclass(frozen=True, slots=True)
class Terms:
    """What a server offers every agent."""

    color_codecs: tuple[int, ...]
    depth_codecs: tuple[int, ...]
    datagram_size: int


class Reception:
    """Answers hellos. Nothing but a bounded table changes before an agent has proved to be there."""

    def __init__(
        self,
        roster: Roster,
        rig_key: RigKey,
        random_bytes: RandomBytes,
        terms: Terms,
        sessions: SessionTable,
        rejected: Counter[str],
        send: Callable[[bytes, Address], None],
        tell: Callable[[HelloRefused], None],
        objection: Objection,
    ) -> None:
        """Looks at `sessions`, counts into `rejected`."""
        self._objection = objection
        self.roster = roster
        self._terms, self._sessions = terms, sessions
        self._rig_key, self._random_bytes = rig_key, random_bytes
        self._rejected, self._send, self._tell = rejected, send, tell
        self._closed = False
        self._pending = PendingSessions()
        self._notices = RateLimit(_NOTICE_INTERVAL_NS)
        self._all_notices = RateLimit(_NOTICE_INTERVAL_ALL_NS, max_keys=1)
        self._handshakes = RateLimit(_HANDSHAKE_INTERVAL_NS, max_keys=1, burst=_HANDSHAKE_BURST)
        self._repeats = RateLimit(_REPEAT_INTERVAL_NS)
        self._refusal_events = RateLimit(_REFUSAL_EVENT_INTERVAL_NS)
        self._all_refusal_events = RateLimit(
            _ALL_REFUSAL_EVENTS_INTERVAL_NS, max_keys=1, burst=_ALL_REFUSAL_EVENTS_BURST
        )

    def __contains__(self, session_id: int) -> bool:
        """True for a session that was offered and has not begun."""
        return session_id in self._pending

    def close(self) -> None:
        """Welcome nobody any more."""
        self._closed = True
        self._pending.clear()

    def receive_hello(self, prefix: Prefix, datagram: Buffer, address: Address, now_ns: int) -> None:
        """Take a datagram whose prefix says HELLO, of whatever version."""
        if self._closed:
            self._rejected["closed"] += 1
        elif prefix.id == 0 or not MIN_HELLO_SIZE <= len(datagram) <= _longest(prefix.version):
            self._rejected["malformed"] += 1
        elif prefix.crc != clear_crc(datagram):
            self._rejected["corrupt_control"] += 1
        elif prefix.version != VERSION:
            self._refuse(version_mismatch(prefix.version), prefix.id, address, now_ns)
        else:
            refusal, hello = self._take_hello(prefix.id, datagram, address, now_ns)
            if refusal is not None:
                self._refuse(refusal, prefix.id, address, now_ns, hello)

    def confirm(
        self, session_id: int, datagram: Buffer, address: Address, now_ns: int
    ) -> PendingSession | None:
        """The offered session whose agent a first sealed message proves to be there; None (counted) else."""
        pending = self._pending.of_id(session_id)
        if pending is not None and now_ns - pending.offered_ns > _OFFER_LIFE_NS:
            self._rejected["stale_hello"] += 1  # its agent gave up long ago: somebody held this back
            return None
        if pending is None or pending.address != address:
            self._rejected["wrong_address"] += 1
            return None
        if isinstance(_opened(pending, datagram), str):
            self._rejected["bad_seal"] += 1
            return None
        self._pending.take(session_id)
        return pending

    def notify_unknown(self, session_id: int, address: Address, now_ns: int) -> None:
        """Tell a sender that it has no session here, now and then."""
        if session_id not in self._pending and self._may_notify(address, now_ns):
            self._send(encode_clear(*encode_body(UnknownSession()), session_id), address)

    def _take_hello(
        self, nonce: int, datagram: Buffer, address: Address, now_ns: int
    ) -> tuple[Reject | None, Hello | None]:
        """Answer a hello, or say why not; with what it says, where that was read."""
        if self._pending.was_used(nonce):
            self._rejected["stale_hello"] += 1  # a copy of an old one
            return None, None
        known = self._pending.of_hello(nonce, address)
        if known is not None:
            self._send(known.welcome_datagram, address)  # our answer was lost
            return None, None
        try:
            body = open_hello(datagram, nonce, self._rig_key)
            # What follows takes time, and the hello may be a recorded one. An agent tries again in a moment.
            if not (self._repeats.allows(nonce, now_ns) and self._handshakes.allows("all", now_ns)):
                self._rejected["handshake_limit"] += 1
                return None, None
            hello = decode_hello(body)
        except NotAuthentic:
            return wrong_key(self._rig_key.is_public), None
        except DataError as error:
            return malformed_hello(error), None
        welcome = self._choose(hello, address, now_ns)
        if isinstance(welcome, Reject):
            return welcome, hello
        self._answer(nonce, datagram, hello, welcome, address, now_ns)
        return None, hello

    def _choose(self, hello: Hello, address: Address, now_ns: int) -> Welcome | Reject:
        sessions, terms = self._sessions, self._terms
        camera_id = self.roster.assign(hello, sessions.recall(hello, address), sessions.taken(hello, address))
        if isinstance(camera_id, Reject):
            return camera_id
        holder = sessions.of_camera(camera_id)
        if holder is not None and not gives_way(holder, hello, address, now_ns):
            return duplicate_slot(holder, hello, now_ns)
        codecs = choose_codecs(hello, terms.color_codecs, terms.depth_codecs)
        if isinstance(codecs, Reject):
            return codecs
        objection = self._objection(camera_id, hello, address, now_ns)
        if objection is not None:
            return no_room(objection)
        return Welcome(
            self._new_session_id(),
            camera_id,
            *codecs,
            terms.datagram_size,
            hello.ciphers[0],
            controls=hello.controls,
        )

    def _answer(
        self, nonce: int, datagram: Buffer, hello: Hello, welcome: Welcome, address: Address, now_ns: int
    ) -> None:
        try:
            answer, agreement = answer_hello(datagram, nonce, welcome, self._rig_key, self._random_bytes)
        except DataError:
            self._rejected["malformed"] += 1
            return
        self._pending.add(PendingSession(hello, nonce, address, agreement, answer, now_ns))
        self._send(answer, address)

    def _refuse(
        self, reject: Reject, nonce: int, address: Address, now_ns: int, hello: Hello | None = None
    ) -> None:
        self._rejected[f"refused_{reject.reason.name.lower()}"] += 1
        if self._may_notify(address, now_ns):
            self._send(encode_clear(*encode_body(reject), nonce), address)
        if self._refusal_events.allows(address[0], now_ns) and self._all_refusal_events.allows("all", now_ns):
            self._tell(HelloRefused(address, reject.reason, reject.text, hello))

    def _may_notify(self, address: Address, now_ns: int) -> bool:
        return self._notices.allows(address, now_ns) and self._all_notices.allows("all", now_ns)

    def _new_session_id(self) -> int:
        while (session_id := fresh_id(self._random_bytes)) in self._sessions or session_id in self._pending:
            continue
        return session_id


def _longest(version: int) -> int:
    """Bytes of a hello; other versions may have longer ones."""
    return MAX_CONTROL_SIZE if version == VERSION else MAX_DATAGRAM_SIZE


def _opened(pending: PendingSession, datagram: Buffer) -> bytes | str:
    """The body of a sealed datagram by the keys of a session that has not begun."""
    welcome, keys = pending.agreement.welcome, pending.agreement.keys
    channel = SealedChannel(welcome.cipher, keys.server_control, keys.agent_control, welcome.session_id)
    return channel.open(datagram)
