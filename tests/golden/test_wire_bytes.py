"""The bytes of version 2, pinned: other implementations must pass these vectors, ours never changes them."""

import json
import zlib
from pathlib import Path

import pytest

from rig_protocol.counters import CameraCounters
from rig_protocol.datagram import DatagramBatch, consecutive_runs, parse_fragment_header, parse_prefix
from rig_protocol.events import Rejected
from rig_protocol.frames import EncodedFrame
from rig_protocol.handshake import open_hello
from rig_protocol.message_bytes import decode_body, decode_hello
from rig_protocol.messages import Hello, Message, RejectReason
from rig_protocol.reassembler import Reassembler
from rig_protocol.sealed_channel import SealedChannel
from rig_protocol.security import Cipher, FrameSeal, SessionKeys
from support import golden_messages as golden
from support.wire import AGENT, T0, events_of, make_agent, make_server

VECTORS = json.loads((Path(__file__).parent / "wire_v2.json").read_text())
KEYS = SessionKeys(*(bytes.fromhex(VECTORS["session keys"][name]) for name in SessionKeys.__slots__))


def hexed(datagrams: dict[str, bytes]) -> dict[str, str]:
    return {name: datagram.hex() for name, datagram in datagrams.items()}


def said(hello: Hello) -> list[object]:
    """What a hello says; its camera model holds arrays, which compare by their plain form."""
    return [getattr(hello, name) for name in Hello.__slots__ if name != "model"] + [hello.model.to_dict()]


def test_the_handshake_is_written_as_pinned() -> None:
    assert {name: golden.hello_of(name).datagram.hex() for name in golden.HELLOS} == VECTORS["hellos"]
    welcome, keys = golden.welcome_and_keys()
    assert welcome.hex() == VECTORS["welcome"]
    assert keys == KEYS
    assert golden.welcome_and_keys(golden.WELCOME_WITH_CONTROLS)[0].hex() == VECTORS["welcome with controls"]


@pytest.mark.parametrize("name", golden.HELLOS)
def test_a_pinned_hello_is_read(name: str) -> None:
    body = open_hello(bytes.fromhex(VECTORS["hellos"][name]), golden.NONCE, golden.RIG_KEY)
    hello = decode_hello(body)
    assert said(hello) == said(golden.HELLOS[name])


def test_the_pinned_welcome_is_read() -> None:
    agreement = golden.hello_of("full").open_welcome(bytes.fromhex(VECTORS["welcome"]))
    assert (agreement.welcome, agreement.keys) == (golden.WELCOME, KEYS)
    agreement = golden.hello_of("full").open_welcome(bytes.fromhex(VECTORS["welcome with controls"]))
    assert agreement.welcome == golden.WELCOME_WITH_CONTROLS


def test_messages_outside_of_a_session_are_written_and_read_as_pinned() -> None:
    assert hexed(golden.clear_datagrams()) == VECTORS["clear"]
    for name, (message, id_) in golden.CLEAR.items():
        datagram = bytes.fromhex(VECTORS["clear"][name])
        prefix = parse_prefix(datagram)
        assert prefix is not None
        assert (prefix.id, decode_body(prefix.type, datagram[16:])) == (id_, message)


@pytest.mark.parametrize("cipher", Cipher)
def test_the_messages_of_a_session_are_written_as_pinned(cipher: Cipher) -> None:
    from_agent, from_server = golden.sealed_datagrams(cipher)
    assert hexed(from_agent) == VECTORS[cipher.name]["from agent"]
    assert hexed(from_server) == VECTORS[cipher.name]["from server"]


@pytest.mark.parametrize("cipher", Cipher)
def test_the_pinned_messages_of_a_session_are_read(cipher: Cipher) -> None:
    agent, server = golden.channels(cipher)
    assert read(server, VECTORS[cipher.name]["from agent"]) == golden.FROM_AGENT
    assert read(agent, VECTORS[cipher.name]["from server"]) == golden.FROM_SERVER


def read(channel: SealedChannel, datagrams: dict[str, str]) -> dict[str, Message]:
    found = {}
    for name, text in datagrams.items():
        datagram = bytes.fromhex(text)
        body = channel.open(datagram)
        assert isinstance(body, bytes)
        found[name] = decode_body(datagram[3], body)
    return found


@pytest.mark.parametrize("cipher", Cipher)
def test_the_datagrams_of_a_frame_are_written_as_pinned(cipher: Cipher) -> None:
    batch = golden.frame_datagrams(cipher)
    assert [bytes(datagram).hex() for datagram in batch] == VECTORS[cipher.name]["frame"]


@pytest.mark.parametrize("cipher", Cipher)
def test_the_pinned_datagrams_of_a_frame_are_read(cipher: Cipher) -> None:
    reassembler = Reassembler(golden.FRAME.camera_id, 30.0, CameraCounters(), FrameSeal(cipher, KEYS))
    content = bytes.fromhex("".join(VECTORS[cipher.name]["frame"]))
    frame: EncodedFrame | None = None
    for count, run in consecutive_runs(DatagramBatch(content, golden.DATAGRAM_SIZE)):
        header = parse_fragment_header(run)
        assert header is not None
        frame = reassembler.receive(header, run, count, 0)
    assert frame == golden.FRAME


def test_a_hello_of_version_1_is_refused_in_words_that_version_1_reads() -> None:
    server = make_server()
    server.receive_datagram(bytes.fromhex(VECTORS["version 1"]["hello"]), AGENT, T0)
    [(answer, _)] = server.datagrams_to_send(T0)
    # What version 1 checks: magic, type, crc, its nonce; then reason, lowest and highest version, text.
    assert (answer[:2], answer[3], answer[8:16]) == (b"KR", 3, golden.NONCE.to_bytes(8, "little"))
    assert int.from_bytes(answer[4:8], "little") == zlib.crc32(answer[:4] + answer[8:])
    assert tuple(answer[16:20]) == (1, 2, 2, 0)
    assert "install the same release on both" in answer[20:].decode()


def test_a_refusal_by_version_1_is_read_and_told() -> None:
    agent = make_agent(random_bytes=golden.given(golden.NONCE, golden.AGENT_PRIVATE))
    agent.datagrams_to_send(T0)
    agent.receive_datagram(bytes.fromhex(VECTORS["version 1"]["reject"]), T0)
    assert events_of(agent) == [Rejected(RejectReason.DUPLICATE_SLOT, "slot 7 is held")]
