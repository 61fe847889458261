"""The bytes of version 1, pinned: other implementations must pass these vectors, ours never changes them."""

import json
from pathlib import Path

import pytest

from rig_protocol.counters import CameraCounters
from rig_protocol.datagram import DatagramBatch, consecutive_runs, parse_fragment_header, parse_prefix
from rig_protocol.fragmenter import fragment
from rig_protocol.frames import EncodedFrame
from rig_protocol.message_bytes import control_crc, decode_message, encode_message
from rig_protocol.messages import Hello
from rig_protocol.reassembler import Reassembler
from support.golden_messages import FRAME, FRAME_NUMBER, ID, MESSAGES

VECTORS = json.loads((Path(__file__).parent / "wire_v1.json").read_text())
DATAGRAM_SIZE = 1200


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_is_written_as_pinned(name: str) -> None:
    assert encode_message(MESSAGES[name], ID).hex() == VECTORS["messages"][name]


@pytest.mark.parametrize("name", MESSAGES)
def test_a_pinned_message_is_read(name: str) -> None:
    datagram = bytes.fromhex(VECTORS["messages"][name])
    prefix = parse_prefix(datagram)
    assert prefix is not None
    assert (prefix.id, prefix.crc) == (ID, control_crc(datagram))
    read, expected = decode_message(prefix, datagram), MESSAGES[name]
    if isinstance(read, Hello) and isinstance(expected, Hello):  # a model holds arrays: compare what they say
        assert read.model.to_dict() == expected.model.to_dict()
        read, expected = (
            [getattr(hello, field) for field in Hello.__slots__ if field != "model"]
            for hello in (read, expected)
        )
    assert read == expected


def test_the_datagrams_of_a_frame_are_written_as_pinned() -> None:
    batch = fragment(FRAME, ID, DATAGRAM_SIZE, FRAME_NUMBER)
    assert [bytes(datagram).hex() for datagram in batch] == VECTORS["frame"]


def test_the_pinned_datagrams_of_a_frame_are_read() -> None:
    reassembler = Reassembler(FRAME.camera_id, 30.0, CameraCounters())
    batch = DatagramBatch(bytes.fromhex("".join(VECTORS["frame"])), DATAGRAM_SIZE)
    frame: EncodedFrame | None = None
    for count, run in consecutive_runs(batch):
        header = parse_fragment_header(run)
        assert header is not None
        frame = reassembler.receive(header, run, count, 0)
    assert frame == FRAME


def test_the_vectors_pin_nothing_else() -> None:
    assert set(VECTORS["messages"]) == set(MESSAGES)
