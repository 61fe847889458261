"""Hello and welcome: how two ends that hold the key agree on a session (protocol/SPEC.md, section 6)."""

from dataclasses import dataclass, field

from rig_protocol.clear_datagram import encode_clear
from rig_protocol.datagram import PREFIX_SIZE, Buffer, MessageType, pack_prefix
from rig_protocol.errors import DataError
from rig_protocol.message_bytes import decode_welcome, encode_body
from rig_protocol.messages import Hello, Welcome
from rig_protocol.rig_key import RigKey
from rig_protocol.security import (
    PUBLIC_KEY_SIZE,
    TAG_SIZE,
    Cipher,
    EphemeralKey,
    RandomBytes,
    SessionKeys,
    hello_aead,
    make_aead,
    open_once,
    seal_once,
)

_PUBLIC_END = PREFIX_SIZE + PUBLIC_KEY_SIZE
# Welcomes are few: the cipher that every processor runs well.
_WELCOME_CIPHER = Cipher.CHACHA20_POLY1305


class NotAuthentic(DataError):  # noqa: N818  # it reads as what is wrong
    """The sender does not hold the key, or the bytes were altered."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """A session as one end sees it: what was welcomed, under which secrets."""

    welcome: Welcome
    keys: SessionKeys = field(repr=False)


class AgentHandshake:
    """The agent's side of one handshake: one nonce, one key pair, one hello, sent as often as it takes."""

    def __init__(self, hello: Hello, rig_key: RigKey, random_bytes: RandomBytes) -> None:
        """LinkUsageError for a hello against the limits."""
        self.nonce = fresh_id(random_bytes)
        self._rig_key = rig_key
        self._ephemeral = EphemeralKey(random_bytes)
        _, body = encode_body(hello)
        public = self._ephemeral.public
        sealed = seal_once(
            hello_aead(rig_key, public), body, _associated(MessageType.HELLO, self.nonce, public)
        )
        self.datagram = encode_clear(MessageType.HELLO, public + sealed, self.nonce)

    def open_welcome(self, datagram: Buffer) -> Agreement:
        """The session that a welcome with our nonce offers; DataError when it is not our server's."""
        public, sealed = _split(datagram)
        keys = self._ephemeral.session_keys(public, self._rig_key, self.datagram + public)
        associated = _associated(MessageType.WELCOME, self.nonce, public)
        body = open_once(make_aead(_WELCOME_CIPHER, keys.welcome), sealed, associated)
        if body is None:
            raise NotAuthentic("the welcome is not from a server that holds our key")
        return Agreement(decode_welcome(body), keys)


def open_hello(datagram: Buffer, nonce: int, rig_key: RigKey) -> bytes:
    """The body of a hello whose maker holds the rig's key; NotAuthentic else, DataError when too short."""
    public, sealed = _split(datagram)
    associated = _associated(MessageType.HELLO, nonce, public)
    body = open_once(hello_aead(rig_key, public), sealed, associated)
    if body is None:
        raise NotAuthentic("the hello is sealed with another key")
    return body


def answer_hello(
    hello_datagram: Buffer, nonce: int, welcome: Welcome, rig_key: RigKey, random_bytes: RandomBytes
) -> tuple[bytes, Agreement]:
    """The welcome datagram and its session; DataError for a public key that no honest agent sends."""
    ephemeral = EphemeralKey(random_bytes)
    public, _ = _split(hello_datagram)
    transcript = bytes(hello_datagram) + ephemeral.public
    keys = ephemeral.session_keys(public, rig_key, transcript)
    associated = _associated(MessageType.WELCOME, nonce, ephemeral.public)
    _, body = encode_body(welcome)
    sealed = seal_once(make_aead(_WELCOME_CIPHER, keys.welcome), body, associated)
    return encode_clear(MessageType.WELCOME, ephemeral.public + sealed, nonce), Agreement(welcome, keys)


def fresh_id(random_bytes: RandomBytes) -> int:
    """An unguessable nonce or session id; never 0, which is neither."""
    while not (number := int.from_bytes(random_bytes(8), "little")):
        continue
    return number


def _split(datagram: Buffer) -> tuple[bytes, Buffer]:
    """Public key and sealed body."""
    if len(datagram) < _PUBLIC_END + TAG_SIZE:
        raise DataError(f"{len(datagram)} bytes hold no public key and sealed body")
    return bytes(datagram[PREFIX_SIZE:_PUBLIC_END]), datagram[_PUBLIC_END:]


def _associated(message_type: MessageType, id_: int, public: bytes) -> bytes:
    """What a sealed body is bound to: its prefix without the crc, and the public key before it."""
    return pack_prefix(message_type, 0, id_) + public
