"""Control messages of a session on the wire: sealed, counted, accepted once (protocol/SPEC.md, section 6)."""

import struct

from cryptography.exceptions import InvalidTag

from rig_protocol.datagram import PREFIX_SIZE, Buffer, MessageType, pack_prefix
from rig_protocol.security import TAG_SIZE, Cipher, counter_nonce, make_aead

_COUNTER = struct.Struct("<Q")
SEALED_HEADER_SIZE = PREFIX_SIZE + _COUNTER.size
SEALED_OVERHEAD = SEALED_HEADER_SIZE + TAG_SIZE
# Messages of one side that may overtake each other on the way: two seconds of them at most.
_WINDOW = 64


class SealedChannel:
    """One end's two directions within one session."""

    def __init__(self, cipher: Cipher, send_key: bytes, receive_key: bytes, session_id: int) -> None:
        self._send, self._receive = make_aead(cipher, send_key), make_aead(cipher, receive_key)
        self._session_id = session_id
        self._counter = 0
        self._replays = ReplayWindow()

    def seal(self, message_type: MessageType, body: bytes) -> bytes:
        """The datagram of a message."""
        header = pack_prefix(message_type, 0, self._session_id) + _COUNTER.pack(self._counter)
        sealed = self._send.encrypt(counter_nonce(self._counter), body, header)
        self._counter += 1
        return header + sealed

    def open(self, datagram: Buffer) -> bytes | str:
        """The body of a datagram of this session, or the name of the cause for which it is dropped."""
        if len(datagram) < SEALED_OVERHEAD:
            return "malformed"
        header = bytes(datagram[:SEALED_HEADER_SIZE])
        (counter,) = _COUNTER.unpack_from(header, PREFIX_SIZE)
        if not self._replays.is_fresh(counter):
            return "replayed"
        try:
            body = self._receive.decrypt(counter_nonce(counter), datagram[SEALED_HEADER_SIZE:], header)
        except InvalidTag:
            return "bad_seal"
        self._replays.accept(counter)
        return body


class ReplayWindow:
    """Which of the latest counters were seen (RFC 4303, section 3.4.3)."""

    def __init__(self) -> None:
        self._next = 0
        self._seen = 0  # bit k: the counter k + 1 below `_next` was seen

    def is_fresh(self, counter: int) -> bool:
        """True for a counter that was not seen and is not too old to tell."""
        age = self._next - 1 - counter
        return age < 0 or (age < _WINDOW and not self._seen >> age & 1)

    def accept(self, counter: int) -> None:
        """Remember the counter of an authentic message."""
        ahead = counter - (self._next - 1)
        if ahead > 0:
            self._seen = (self._seen << ahead | 1) & ((1 << _WINDOW) - 1) if ahead < _WINDOW else 1
            self._next = counter + 1
        else:
            self._seen |= 1 << -ahead
