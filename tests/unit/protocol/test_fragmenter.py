from dataclasses import replace

import numpy as np
import pytest

from rig_protocol.datagram import FRAGMENT_HEADER_SIZE, parse_fragment_header
from rig_protocol.errors import DataError, LinkUsageError
from rig_protocol.fragmenter import fragment
from rig_protocol.frame_unit import (
    FRAME_HEADER_SIZE,
    MAX_UNIT_SIZE,
    frame_crc,
    pack_unit,
    parse_unit,
)
from rig_protocol.frames import EncodedFrame, Payload
from support.wire import COLOR, DEPTH, make_frame

SESSION = 0xABCDEF


def test_frame_header_byte_layout() -> None:
    frame = EncodedFrame(
        camera_id=0,
        sequence=0x0102,
        timestamp_ns=-1,
        uncertainty_ns=7,
        color=Payload(2, b"CC"),
        depth=Payload(5, b"D"),
        depth_frame="color",
        damaged=True,
    )
    expected = "0201000000000000 ffffffffffffffff 07000000 0f 02 05 00 02000000 01000000 4343 44"
    assert pack_unit(frame) == bytes.fromhex(expected.replace(" ", ""))


@pytest.mark.parametrize(
    "frame",
    [
        make_frame(),
        make_frame(color=None),
        make_frame(depth=None, damaged=True),
        make_frame(color=None, depth=None),
        make_frame(color=Payload(1, b""), depth_frame="color"),
        make_frame(2**64 - 1, -(2**63), uncertainty_ns=2**32 - 1),
    ],
)
def test_a_frame_survives_its_unit(frame: EncodedFrame) -> None:
    assert parse_unit(pack_unit(frame), frame.camera_id) == frame


def test_an_uncertainty_beyond_its_field_saturates() -> None:
    frame = parse_unit(pack_unit(make_frame(uncertainty_ns=2**40)), 0)
    assert frame.uncertainty_ns == 2**32 - 1


@pytest.mark.parametrize(
    ("offset", "value"),
    [(20, 0x1F), (20, 0x80), (20, 0b0100), (21, 0), (22, 0), (24, 99), (28, 99), (31, 255)],
)
def test_a_unit_that_contradicts_its_header_is_malformed(offset: int, value: int) -> None:
    unit = bytearray(pack_unit(make_frame(size=30)))
    unit[offset] = value
    with pytest.raises(DataError):
        parse_unit(unit, 0)


def test_a_unit_shorter_than_its_header_is_malformed() -> None:
    with pytest.raises(DataError):
        parse_unit(bytes(FRAME_HEADER_SIZE - 1), 0)


@pytest.mark.parametrize(
    "frame",
    [
        make_frame(-1),
        make_frame(timestamp_ns=2**63),
        make_frame(color=Payload(256, b"")),
        make_frame(color=Payload(2, bytes(MAX_UNIT_SIZE))),
    ],
)
def test_a_frame_over_the_limits_is_misuse(frame: EncodedFrame) -> None:
    with pytest.raises(LinkUsageError):
        pack_unit(frame)


@pytest.mark.parametrize("size", [0, 1, 1408, 1409, 1440, 2848, 2849, 240_000])
@pytest.mark.parametrize("datagram_size", [1200, 1472, 8972])
def test_fragments_are_full_but_the_last_and_carry_the_unit_in_order(size: int, datagram_size: int) -> None:
    frame = make_frame(size=size)
    batch = fragment(frame, SESSION, datagram_size, 9)
    sizes = [len(datagram) for datagram in batch]
    assert sizes[:-1] == [datagram_size] * (len(batch) - 1)
    assert FRAGMENT_HEADER_SIZE < sizes[-1] <= datagram_size
    assert b"".join(bytes(datagram[FRAGMENT_HEADER_SIZE:]) for datagram in batch) == pack_unit(frame)


def test_every_fragment_repeats_what_identifies_the_frame() -> None:
    frame = make_frame(size=5000)
    headers = [parse_fragment_header(datagram) for datagram in fragment(frame, SESSION, 1472, 9)]
    first = headers[0]
    assert first is not None
    assert (first.session_id, first.frame_number, first.unit_size) == (SESSION, 9, len(pack_unit(frame)))
    assert first.frame_crc == frame_crc(pack_unit(frame), first)
    assert headers == [first._replace(fragment_index=k) for k in range(4)]


def test_the_crc_binds_a_unit_to_session_number_and_layout() -> None:
    unit = pack_unit(make_frame())
    header = parse_fragment_header(fragment(make_frame(), SESSION)[0])
    assert header is not None
    for field in ("session_id", "frame_number", "unit_size", "payload_size"):
        moved = header._replace(**{field: getattr(header, field) + 1})
        assert frame_crc(unit, moved) != frame_crc(unit, header)


def test_a_frame_without_a_number_goes_out_under_its_sequence() -> None:
    header = parse_fragment_header(fragment(make_frame(31), SESSION)[0])
    assert header is not None
    assert header.frame_number == 31


@pytest.mark.parametrize("datagram_size", [0, 32, 63, 65508])
def test_a_datagram_size_that_cannot_carry_every_frame_is_misuse(datagram_size: int) -> None:
    with pytest.raises(LinkUsageError):
        fragment(make_frame(), SESSION, datagram_size)


def test_payloads_may_be_any_bytes_like_object() -> None:
    frame = make_frame()
    assert frame.color is not None
    viewed = replace(frame, color=Payload(COLOR, memoryview(np.frombuffer(frame.color.data, np.uint8))))  # type: ignore[arg-type]
    assert pack_unit(viewed) == pack_unit(frame)
    assert frame.depth is not None
    assert frame.depth.codec_id == DEPTH
