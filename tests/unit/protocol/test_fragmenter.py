from dataclasses import replace

import numpy as np
import pytest

from rig_protocol.datagram import FRAGMENT_HEADER_SIZE, parse_fragment_header
from rig_protocol.errors import DataError, LinkUsageError
from rig_protocol.fragmenter import fragment
from rig_protocol.frame_unit import (
    FRAME_HEADER_SIZE,
    MAX_UNIT_SIZE,
    leading_seal,
    pack_unit,
    parse_unit,
    sealed_place,
)
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.security import TAG_SIZE
from support.wire import COLOR, DEPTH, make_frame, make_seal

SESSION = 0xABCDEF
SEAL = make_seal()


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


@pytest.mark.parametrize("size", [0, 1, 1392, 1393, 1440, 2832, 2833, 240_000])
@pytest.mark.parametrize("datagram_size", [1200, 1472, 8972])
def test_fragments_are_full_but_the_last_and_carry_the_sealed_unit_in_order(
    size: int, datagram_size: int
) -> None:
    frame = make_frame(size=size)
    batch = fragment(frame, SESSION, 9, SEAL, datagram_size)
    sizes = [len(datagram) for datagram in batch]
    assert sizes[:-1] == [datagram_size] * (len(batch) - 1)
    assert FRAGMENT_HEADER_SIZE < sizes[-1] <= datagram_size
    header = parse_fragment_header(batch[0])
    assert header is not None
    sealed = b"".join(bytes(datagram[FRAGMENT_HEADER_SIZE:]) for datagram in batch)
    assert SEAL.open(9, sealed, sealed_place(header)) == pack_unit(frame)


def test_no_payload_byte_travels_in_the_clear() -> None:
    frame = make_frame(size=3000)
    batch = bytes(fragment(frame, SESSION, 9, SEAL).buffer)
    assert frame.color is not None
    assert not any(bytes(frame.color.data[k : k + 8]) in batch for k in range(0, 1900, 8))


def test_every_fragment_repeats_what_identifies_the_frame() -> None:
    frame = make_frame(size=5000)
    batch = fragment(frame, SESSION, 9, SEAL)
    headers = [parse_fragment_header(datagram) for datagram in batch]
    first = headers[0]
    assert first is not None
    sealed_size = len(pack_unit(frame)) + TAG_SIZE
    assert (first.session_id, first.frame_number, first.unit_size) == (SESSION, 9, sealed_size)
    sealed = b"".join(bytes(datagram[FRAGMENT_HEADER_SIZE:]) for datagram in batch)
    assert first.seal == leading_seal(sealed)
    assert headers == [first._replace(fragment_index=k) for k in range(4)]


def test_the_seal_binds_a_unit_to_session_number_and_layout() -> None:
    batch = fragment(make_frame(size=1000), SESSION, 9, SEAL)
    header = parse_fragment_header(batch[0])
    assert header is not None
    sealed = bytes(batch[0][FRAGMENT_HEADER_SIZE:])
    assert SEAL.open(9, sealed, sealed_place(header)) is not None
    for field in ("session_id", "frame_number", "unit_size", "payload_size"):
        moved = header._replace(**{field: getattr(header, field) + 1})
        assert SEAL.open(moved.frame_number, sealed, sealed_place(moved)) is None


def test_the_same_frame_under_two_numbers_or_keys_has_nothing_in_common() -> None:
    frame = make_frame(size=1000)
    one, other = (
        bytes(fragment(frame, SESSION, number, SEAL)[0][FRAGMENT_HEADER_SIZE:]) for number in (1, 2)
    )
    foreign = bytes(fragment(frame, SESSION, 1, make_seal(5))[0][FRAGMENT_HEADER_SIZE:])
    for sealed in (other, foreign):
        assert not any(one[k : k + 8] == sealed[k : k + 8] for k in range(0, 1000, 8))


@pytest.mark.parametrize("datagram_size", [0, 32, 63, 64, 65508])
def test_a_datagram_size_that_cannot_carry_every_frame_is_misuse(datagram_size: int) -> None:
    with pytest.raises(LinkUsageError):
        fragment(make_frame(), SESSION, 9, SEAL, datagram_size)


def test_payloads_may_be_any_bytes_like_object() -> None:
    frame = make_frame()
    assert frame.color is not None
    viewed = replace(frame, color=Payload(COLOR, memoryview(np.frombuffer(frame.color.data, np.uint8))))  # type: ignore[arg-type]
    assert pack_unit(viewed) == pack_unit(frame)
    assert frame.depth is not None
    assert frame.depth.codec_id == DEPTH
