"""One end of the protocol that says exactly what a test wants, and reads what the other end says."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from rig_protocol.datagram import Buffer, DatagramBatch, MessageType, parse_prefix
from rig_protocol.fragmenter import fragment
from rig_protocol.frames import EncodedFrame
from rig_protocol.handshake import AgentHandshake, Agreement, answer_hello, open_hello
from rig_protocol.message_bytes import decode_body, decode_hello, encode_body
from rig_protocol.messages import Hello, Message, Welcome
from rig_protocol.rig_key import RigKey
from rig_protocol.sealed_channel import SealedChannel
from rig_protocol.security import FrameSeal
from support.wire import COLOR, DEPTH, KEY, make_hello, random_bytes

WELCOME = Welcome(
    session_id=77,
    camera_id=4,
    color_codecs=(COLOR,),
    depth_codecs=(DEPTH,),
    datagram_size=1472,
    cipher=make_hello().ciphers[0],
)


def id_of(datagram: Buffer) -> int:
    """Nonce or session id."""
    prefix = parse_prefix(datagram)
    assert prefix is not None
    return prefix.id


def clear_message(datagram: bytes) -> Message:
    """What a datagram outside of a session says: REJECT, UNKNOWN_SESSION."""
    prefix = parse_prefix(datagram)
    assert prefix is not None
    return decode_body(prefix.type, datagram[16:])


class ServerPeer:
    """A server that welcomes one agent."""

    def __init__(self, rig_key: RigKey = KEY, seed: int = 7) -> None:
        self._rig_key, self._random_bytes = rig_key, random_bytes(seed)
        self._channel: SealedChannel | None = None

    def read_hello(self, datagram: bytes) -> Hello:
        """What the agent says of itself."""
        return decode_hello(open_hello(datagram, id_of(datagram), self._rig_key))

    def welcome(self, hello: bytes, **changes: Any) -> bytes:
        """Answer a hello: WELCOME with changes."""
        welcome = replace(WELCOME, **changes)
        datagram, agreement = answer_hello(hello, id_of(hello), welcome, self._rig_key, self._random_bytes)
        keys = agreement.keys
        self._channel = SealedChannel(
            welcome.cipher, keys.server_control, keys.agent_control, welcome.session_id
        )
        return datagram

    def seal(self, message: Message) -> bytes:
        """The datagram of a message to the agent."""
        return self.seal_body(*encode_body(message))

    def seal_body(self, message_type: MessageType, body: bytes) -> bytes:
        """The datagram of any body."""
        assert self._channel is not None
        return self._channel.seal(message_type, body)

    def read(self, datagrams: Iterable[bytes]) -> list[Message]:
        """What the agent's sealed datagrams say."""
        return [_read(self._channel, datagram) for datagram in datagrams]


class AgentPeer:
    """An agent that joins one server."""

    def __init__(self, hello: Hello | None = None, rig_key: RigKey = KEY, seed: int = 8) -> None:
        self._handshake = AgentHandshake(hello or make_hello(), rig_key, random_bytes(seed))
        self.hello = self._handshake.datagram
        self.nonce = self._handshake.nonce
        self._agreement: Agreement | None = None
        self._channel: SealedChannel | None = None

    def accept(self, welcome: bytes) -> Welcome:
        """Take the server's choices."""
        self._agreement = agreement = self._handshake.open_welcome(welcome)
        keys, chosen = agreement.keys, agreement.welcome
        self._channel = SealedChannel(
            chosen.cipher, keys.agent_control, keys.server_control, chosen.session_id
        )
        return chosen

    def seal(self, message: Message) -> bytes:
        """The datagram of a message to the server."""
        return self.seal_body(*encode_body(message))

    def seal_body(self, message_type: MessageType, body: bytes) -> bytes:
        """The datagram of any body."""
        assert self._channel is not None
        return self._channel.seal(message_type, body)

    def read(self, datagrams: Iterable[bytes]) -> list[Message]:
        """What the server's sealed datagrams say."""
        return [_read(self._channel, datagram) for datagram in datagrams]

    def fragments(self, frame: EncodedFrame, number: int) -> DatagramBatch:
        """The datagrams of a frame."""
        assert self._agreement is not None
        welcome = self._agreement.welcome
        seal = FrameSeal(welcome.cipher, self._agreement.keys)
        return fragment(frame, welcome.session_id, number, seal, welcome.datagram_size)


def _read(channel: SealedChannel | None, datagram: bytes) -> Message:
    assert channel is not None
    body = channel.open(datagram)
    assert not isinstance(body, str), body
    prefix = parse_prefix(datagram)
    assert prefix is not None
    return decode_body(prefix.type, body)
