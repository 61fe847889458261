"""A server link and agents in session, for tests of what then happens."""

from typing import Any

from rig_protocol.agent_link import AgentLink
from rig_protocol.clear_datagram import clear_crc, encode_clear
from rig_protocol.datagram import MessageType, pack_prefix
from rig_protocol.events import Address, CameraJoined
from rig_protocol.message_bytes import encode_body
from rig_protocol.messages import (
    Heartbeat,
    Hello,
    Message,
)
from rig_protocol.rig_key import RigKey
from rig_protocol.security import hello_aead, seal_once
from rig_protocol.server_link import ServerLink
from support.peers import AgentPeer, clear_message
from support.wire import (
    AGENT,
    KEY,
    T0,
    events_of,
    make_agent,
    make_frame,
    make_hello,
    roundtrip,
)

HELLO = AgentPeer().hello
STEP_NS = 10_000_000  # of the server between two handshakes


def with_crc(datagram: bytes | bytearray) -> bytes:
    """The datagram with the crc that it should have."""
    return bytes(datagram[:4]) + clear_crc(bytes(datagram)).to_bytes(4, "little") + bytes(datagram[8:])


def clear(message: Message, id_: int) -> bytes:
    return encode_clear(*encode_body(message), id_)


def sealed_hello(body: bytes, nonce: int = 1, public: bytes = bytes(32), rig_key: RigKey = KEY) -> bytes:
    """A hello of any body and public key by somebody who holds the key."""
    associated = pack_prefix(MessageType.HELLO, 0, nonce) + public
    return encode_clear(
        MessageType.HELLO, public + seal_once(hello_aead(rig_key, public), body, associated), nonce
    )


def the_answer(server: ServerLink, now_ns: int = T0) -> Message:
    """The only answer, outside of any session."""
    [(datagram, _)] = server.datagrams_to_send(now_ns)
    return clear_message(datagram)


def welcomed(server: ServerLink, peer: AgentPeer, address: Address = AGENT, now_ns: int = T0) -> AgentPeer:
    """The peer with a welcome; the server has not heard from it since."""
    server.receive_datagram(peer.hello, address, now_ns)
    [(welcome, to)] = [(d, a) for d, a in server.datagrams_to_send(now_ns) if d[3] == MessageType.WELCOME]
    assert to == address
    peer.accept(welcome)
    return peer


def joined_peer(
    server: ServerLink, address: Address = AGENT, now_ns: int = T0, seed: int = 8, **changes: Any
) -> AgentPeer:
    """A peer in session; its joining is taken from the events."""
    peer = welcomed(server, AgentPeer(make_hello(**changes), seed=seed), address, now_ns)
    server.receive_datagram(peer.seal(Heartbeat({})), address, now_ns)
    assert [type(event) for event in events_of(server)] == [CameraJoined]
    return peer


def joined(
    server: ServerLink, hello: Hello | None = None, seed: int = 2, address: Address = AGENT, now_ns: int = T0
) -> AgentLink:
    """A connected agent, its clock known; the event of its joining is taken."""
    agent = make_agent(hello, seed)
    roundtrip(agent, server, address, now_ns)
    assert agent.connected
    events_of(server)
    return agent


def session_id(agent: AgentLink) -> int:
    assert agent.session is not None
    return agent.session.session_id


def deliver(server: ServerLink, agent: AgentLink, now_ns: int = T0, **changes: Any) -> None:
    batch = agent.send_frame(make_frame(timestamp_ns=now_ns, **changes), now_ns)
    assert batch is not None
    server.receive_batch(batch, AGENT, now_ns)
