"""Links, hellos and frames for tests of the protocol; everything seeded."""

import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from rig_protocol.agent_link import AgentLink
from rig_protocol.camera import CameraModel
from rig_protocol.events import Address
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.messages import Hello
from rig_protocol.rig_key import RigKey
from rig_protocol.roster import Roster
from rig_protocol.security import Cipher, FrameSeal, SessionKeys
from rig_protocol.server_link import ServerLink

COLOR, DEPTH = 2, 5
KEY = RigKey(bytes(range(32)))
AGENT: Address = ("192.0.2.1", 40001)
OTHER: Address = ("192.0.2.2", 40002)
SECOND_NS = 1_000_000_000
T0 = 100 * SECOND_NS

_HELLO = Hello(
    name="cam00",
    camera_id=0,
    serial="A00362A01234047A",
    port_path="1-1.2",
    model=CameraModel(),
    color_codecs=(COLOR,),
    depth_codecs=(DEPTH,),
    fps=30.0,
    software="test 1",
)


def make_hello(**changes: Any) -> Hello:
    """A hello of camera 0, with changes."""
    return replace(_HELLO, **changes)


def make_frame(sequence: int = 0, timestamp_ns: int = T0, size: int = 4000, **changes: Any) -> EncodedFrame:
    """A frame of about `size` bytes whose content follows from its sequence."""
    content = random.Random(sequence).randbytes(size)
    split = 2 * size // 3
    frame = EncodedFrame(
        camera_id=0,
        sequence=sequence,
        timestamp_ns=timestamp_ns,
        color=Payload(COLOR, content[:split]),
        depth=Payload(DEPTH, content[split:]),
    )
    return replace(frame, **changes)


def random_bytes(seed: int) -> Callable[[int], bytes]:
    """A seeded source of bytes."""
    return random.Random(seed).randbytes


def make_seal(seed: int = 1, cipher: Cipher = Cipher.CHACHA20_POLY1305) -> FrameSeal:
    """The seal of a session's frames."""
    source = random_bytes(seed)
    return FrameSeal(cipher, SessionKeys(*(source(32) for _ in range(4))))


def make_server(roster: Roster | None = None, seed: int = 1, **changes: Any) -> ServerLink:
    """A server that takes every camera, unless a roster says otherwise."""
    options: dict[str, Any] = {
        "rig_key": KEY,
        "random_bytes": random_bytes(seed),
        "color_codecs": (COLOR,),
        "depth_codecs": (DEPTH,),
    }
    return ServerLink(roster or Roster(open=True), **(options | changes))


def make_agent(hello: Hello | None = None, seed: int = 2, **changes: Any) -> AgentLink:
    """An agent's link."""
    options: dict[str, Any] = {"rig_key": KEY, "random_bytes": random_bytes(seed)}
    return AgentLink(hello or make_hello(), **(options | changes))


def roundtrip(agent: AgentLink, server: ServerLink, address: Address = AGENT, now_ns: int = T0) -> None:
    """Carry control datagrams both ways, without loss or delay, until both are quiet."""
    for _ in range(4):
        for datagram in agent.datagrams_to_send(now_ns):
            server.receive_datagram(datagram, address, now_ns)
        server.handle_timeout(now_ns)
        for datagram, to in server.datagrams_to_send(now_ns):
            if to == address:
                agent.receive_datagram(datagram, now_ns)


def events_of(link: AgentLink | ServerLink) -> list[Any]:
    """All events that wait."""
    events = []
    while (event := link.next_event()) is not None:
        events.append(event)
    return events
