import math
from collections.abc import Callable
from typing import Any

import msgpack
import pytest

from rig_protocol.camera import CameraModel, Intrinsics
from rig_protocol.datagram import MessageType, pack_prefix, parse_prefix
from rig_protocol.errors import DataError, LinkUsageError
from rig_protocol.message_bytes import (
    MAX_CONTROL_SIZE,
    MIN_HELLO_SIZE,
    control_crc,
    decode_hello,
    decode_message,
    encode_message,
)
from rig_protocol.messages import (
    ClockReply,
    ClockRequest,
    Goodbye,
    Heartbeat,
    Hello,
    Message,
    Reject,
    RejectReason,
    UnknownSession,
    Welcome,
)
from support.wire import make_hello

SIMPLE: list[Message] = [
    Welcome(session_id=2**64 - 1, camera_id=255, color_codec=None, depth_codec=7, datagram_size=1472),
    Reject(RejectReason.DUPLICATE_SLOT, "slot 3 ist schon vergeben – ü", 1, 4),
    Goodbye(""),
    Goodbye("the agent stops"),
    Heartbeat({}),
    Heartbeat({"temperature_c": 61.5, "load": 2.0}),
    ClockRequest(-(2**63)),
    ClockReply(1, -2, 2**63 - 1),
    UnknownSession(),
]


def decode(datagram: bytes) -> Message:
    prefix = parse_prefix(datagram)
    assert prefix is not None
    return decode_message(prefix, datagram)


def hello_values() -> dict[str, Any]:
    """The map that a good hello carries."""
    values = msgpack.unpackb(encode_message(make_hello(), 1)[16:])
    assert isinstance(values, dict)
    return values


def body_of(kind: MessageType, values: Any) -> bytes:
    return pack_prefix(kind, 0, 1) + msgpack.packb(values)


@pytest.mark.parametrize("message", SIMPLE, ids=lambda message: type(message).__name__)
def test_a_message_survives_its_bytes(message: Message) -> None:
    datagram = encode_message(message, 77)
    prefix = parse_prefix(datagram)
    assert prefix is not None
    assert (prefix.id, prefix.crc) == (77, control_crc(datagram))
    assert decode(datagram) == message


def test_a_hello_survives_its_bytes() -> None:
    lens = Intrinsics(529.2, 525.6, 328.9, 267.5, dist=(0.26, -0.84, -0.002, 0.001, 0.91))
    sent = make_hello(camera_id=None, port_path=None, model=CameraModel(lens, None, None), fps=29.97)
    received = decode(encode_message(sent, 5))
    assert isinstance(received, Hello)
    assert received.model.to_dict() == sent.model.to_dict()
    names = ("name", "camera_id", "serial", "port_path", "color_codecs", "depth_codecs", "fps", "software")
    assert [getattr(received, name) for name in names] == [getattr(sent, name) for name in names]


def test_a_hello_is_never_shorter_than_the_answer_it_may_get() -> None:
    shortest = make_hello(
        name="x", serial=None, port_path=None, model=CameraModel(depth=None, T_color_depth=None)
    )
    assert len(encode_message(shortest, 1)) >= MIN_HELLO_SIZE
    assert len(encode_message(Reject(RejectReason.MALFORMED, "ü" * 5000), 1)) <= MIN_HELLO_SIZE


def test_the_longest_hello_is_one_datagram() -> None:
    lens = Intrinsics(525.1, 525.1, 319.5, 239.5, dist=(0.1, 0.2, 0.3, 0.4, 0.5))
    text, codecs = "n" * 64, tuple(range(240, 256))
    longest = make_hello(
        name=text,
        serial=text,
        port_path=text,
        software=text,
        model=CameraModel(lens, lens),
        color_codecs=codecs,
        depth_codecs=codecs,
    )
    assert len(encode_message(longest, 1)) <= MAX_CONTROL_SIZE


@pytest.mark.parametrize(
    "changes",
    [
        {"name": ""},
        {"name": "x" * 65},
        {"name": "ü" * 33},
        {"name": "red\x1b[31m"},
        {"camera_id": 256},
        {"camera_id": -1},
        {"fps": 0.0},
        {"fps": math.nan},
        {"fps": 241.0},
        {"color_codecs": (0,)},
        {"color_codecs": (256,)},
        {"color_codecs": tuple(range(1, 18))},
        {"color_codecs": (), "depth_codecs": ()},
    ],
)
def test_a_hello_over_the_limits_is_misuse_at_its_origin(changes: dict[str, Any]) -> None:
    with pytest.raises(LinkUsageError, match="this hello cannot be sent"):
        encode_message(make_hello(**changes), 1)


@pytest.mark.parametrize("key", [key for key in hello_values() if key != "padding"])
@pytest.mark.parametrize("value", [None, True, -1, 1.5, math.inf, "", "\x07", [], [[]], {}, b"x", 2**63])
def test_a_hello_with_a_wrong_value_is_malformed_or_good_never_a_crash(key: str, value: Any) -> None:
    datagram = body_of(MessageType.HELLO, {**hello_values(), key: value})
    allowed = {"camera_id": [None], "serial": [None], "port_path": [None], "fps": [1.5]}
    streams = {"color_codecs": [[]], "depth_codecs": [[]]}
    if any(type(value) is type(good) and value == good for good in {**allowed, **streams}.get(key, [])):
        assert isinstance(decode(datagram), Hello)
    else:
        with pytest.raises(DataError):
            decode(datagram)


@pytest.mark.parametrize("key", [key for key in hello_values() if key != "padding"])
def test_a_hello_without_a_value_is_malformed(key: str) -> None:
    values = hello_values()
    del values[key]
    with pytest.raises(DataError):
        decode(body_of(MessageType.HELLO, values))


def test_keys_of_a_later_release_are_ignored() -> None:
    values = {**hello_values(), "resend": {"budget": 0.25}}
    del values["padding"]
    assert isinstance(decode(body_of(MessageType.HELLO, values)), Hello)


@pytest.mark.parametrize(
    "values",
    [
        {"session_id": 0},
        {"session_id": 2**64},
        {"camera_id": None},
        {"color_codec": 0},
        {"datagram_size": 100},
        {"datagram_size": 65508},
    ],
    ids=str,
)
def test_a_welcome_out_of_range_is_malformed(values: dict[str, Any]) -> None:
    good = {"session_id": 1, "camera_id": 0, "color_codec": 1, "depth_codec": None, "datagram_size": 1472}
    assert isinstance(decode(body_of(MessageType.WELCOME, good)), Welcome)
    broken = {**good, **values}
    if values == {"session_id": 2**64}:  # beyond MessagePack
        broken["session_id"] = 1.8e19
    with pytest.raises(DataError):
        decode(body_of(MessageType.WELCOME, broken))


@pytest.mark.parametrize(
    "health",
    [
        {str(i): 0 for i in range(17)},
        {"x" * 33: 1},
        {"t": math.nan},
        {"t": "hot"},
        {"t": True},
        {"": 1},
        [1],
        None,
    ],
    ids=str,
)
def test_health_is_a_few_named_finite_numbers(health: Any) -> None:
    with pytest.raises(DataError):
        decode(body_of(MessageType.HEARTBEAT, {"health": health}))
    if isinstance(health, dict):
        with pytest.raises(LinkUsageError, match="heartbeat"):
            encode_message(Heartbeat(health), 1)


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"\xc1",
        b"\x80\x80",
        b"\x81\x01\x02",
        b"\x81\xa1",
        b"\x90",
        b"\xdf\xff\xff\xff\xff",
        b"\xdd\xff\xff\xff\xff",
        b"\x81\xa4text\xc6\xff\xff\xff\xff",
        b"\x81\xa4text\xa1\xff",
        b"\x91" * 1100,
        b"\x81\xa4text\xd4\x05\x00",
    ],
)
@pytest.mark.parametrize(
    "kind", [MessageType.HELLO, MessageType.WELCOME, MessageType.GOODBYE, MessageType.HEARTBEAT]
)
def test_bytes_that_are_no_map_are_malformed(kind: MessageType, body: bytes) -> None:
    with pytest.raises(DataError):
        decode(pack_prefix(kind, 0, 1) + body)


@pytest.mark.parametrize(
    "kind", [MessageType.CLOCK_REQUEST, MessageType.CLOCK_REPLY, MessageType.UNKNOWN_SESSION]
)
def test_a_fixed_body_of_another_size_is_malformed(kind: MessageType) -> None:
    for size in (1, 7, 9, 23, 25):
        with pytest.raises(DataError):
            decode(pack_prefix(kind, 0, 1) + bytes(size))


def test_a_control_message_is_at_most_1200_bytes() -> None:
    with pytest.raises(DataError, match="1201"):
        decode(pack_prefix(MessageType.GOODBYE, 0, 1) + bytes(1185))


def test_a_reject_of_a_later_version_is_readable() -> None:
    text = "nie gehört \x1b[2J".encode()
    body = bytes((99, 2, 7, 123)) + text + b"\xff"
    reject = decode(pack_prefix(MessageType.REJECT, 0, 1) + body)
    assert reject == Reject(RejectReason.OTHER, "nie gehört ?[2J\N{REPLACEMENT CHARACTER}", 2, 7)


@pytest.mark.parametrize("size", [0, 3, 497])
def test_a_reject_that_is_too_short_or_too_long_is_malformed(size: int) -> None:
    with pytest.raises(DataError):
        decode(pack_prefix(MessageType.REJECT, 0, 1) + bytes(size))


def test_texts_are_cut_to_their_limit_between_characters() -> None:
    goodbye = decode(encode_message(Goodbye("ü" * 150 + "\n"), 1))
    assert goodbye == Goodbye("ü" * 100)


def test_decoding_another_type_as_a_hello_is_misuse() -> None:
    datagram = encode_message(Goodbye("x"), 1)
    prefix = parse_prefix(datagram)
    assert prefix is not None
    with pytest.raises(LinkUsageError):
        decode_hello(prefix, datagram)


@pytest.mark.parametrize("harm", [lambda d: d[:-1], lambda d: d + b"\0", lambda d: d[:20] + b"!" + d[21:]])
def test_the_crc_covers_the_whole_message(harm: Callable[[bytes], bytes]) -> None:
    datagram = encode_message(make_hello(), 1)
    harmed = harm(datagram)
    prefix = parse_prefix(harmed)
    assert prefix is not None
    assert prefix.crc != control_crc(harmed)
