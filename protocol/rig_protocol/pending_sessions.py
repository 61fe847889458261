"""Handshakes that the server has answered and whose agent has not yet proved to be there.

A hello shows that its maker held the rig's key, not that it is fresh: who recorded it can send it again.
Until a first sealed message comes, such a peer gets an answer, a place in this bounded table, and no more.
"""

from collections import OrderedDict
from dataclasses import dataclass

from rig_protocol.events import Address
from rig_protocol.handshake import Agreement
from rig_protocol.messages import Hello

# Five rigs that all join in the same moment.
MAX_PENDING = 64
# A nonce is 8 bytes: copies of the last few thousand hellos are known as such.
MAX_USED_NONCES = 4096


@dataclass(frozen=True, slots=True)
class PendingSession:
    """An answered hello."""

    hello: Hello
    nonce: int
    address: Address
    agreement: Agreement
    welcome_datagram: bytes
    offered_ns: int


class PendingSessions:
    """By session id, and by nonce and address; the oldest gives way. Remembers the nonces of sessions."""

    def __init__(self) -> None:
        self._by_id: OrderedDict[int, PendingSession] = OrderedDict()
        # An agent whose socket was opened anew says the same hello from another port.
        self._ids: dict[tuple[int, Address], int] = {}
        self._used: OrderedDict[int, None] = OrderedDict()

    def __contains__(self, session_id: int) -> bool:
        return session_id in self._by_id

    def of_hello(self, nonce: int, address: Address) -> PendingSession | None:
        """The handshake that this very hello from there began."""
        session_id = self._ids.get((nonce, address))
        return None if session_id is None else self._by_id[session_id]

    def of_id(self, session_id: int) -> PendingSession | None:
        """The handshake whose session this would be."""
        return self._by_id.get(session_id)

    def was_used(self, nonce: int) -> bool:
        """True for a copy of a hello whose session has begun."""
        return nonce in self._used

    def add(self, pending: PendingSession) -> None:
        """Wait for the agent's first sealed message."""
        session_id = pending.agreement.welcome.session_id
        self._by_id[session_id] = pending
        self._ids[pending.nonce, pending.address] = session_id
        if len(self._by_id) > MAX_PENDING:
            _, oldest = self._by_id.popitem(last=False)
            del self._ids[oldest.nonce, oldest.address]

    def take(self, session_id: int) -> None:
        """The session begins: its hello is used."""
        pending = self._by_id.pop(session_id)
        del self._ids[pending.nonce, pending.address]
        self._withdraw_offers(pending.agreement.welcome.camera_id)
        self._used[pending.nonce] = None
        if len(self._used) > MAX_USED_NONCES:
            self._used.popitem(last=False)

    def _withdraw_offers(self, camera_id: int) -> None:
        """The slot is taken: a heartbeat that somebody held back must not take it over."""
        others = [one for one in self._by_id.values() if one.agreement.welcome.camera_id == camera_id]
        for other in others:
            del self._by_id[other.agreement.welcome.session_id]
            del self._ids[other.nonce, other.address]

    def clear(self) -> None:
        """Forget those that wait."""
        self._by_id.clear()
        self._ids.clear()
