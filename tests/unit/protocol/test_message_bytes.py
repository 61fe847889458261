import math
from typing import Any

import msgpack
import pytest

from rig_protocol.camera import CameraModel, Intrinsics
from rig_protocol.datagram import MessageType
from rig_protocol.errors import DataError, LinkUsageError
from rig_protocol.gravity import Gravity
from rig_protocol.message_bytes import (
    HELLO_OVERHEAD,
    MAX_CONTROL_SIZE,
    MAX_RANGES,
    MIN_HELLO_SIZE,
    decode_body,
    encode_body,
)
from rig_protocol.messages import (
    WHOLE_FRAME,
    ClockReply,
    ClockRequest,
    Goodbye,
    Heartbeat,
    Hello,
    Message,
    Reject,
    RejectReason,
    Resend,
    StreamPlan,
    UnknownSession,
    Welcome,
)
from rig_protocol.sealed_channel import SEALED_OVERHEAD
from rig_protocol.security import Cipher
from support.wire import make_hello

SIMPLE: list[Message] = [
    Welcome(2**64 - 1, 255, (), (7, 8), 1472, Cipher.AES_256_GCM),
    Reject(RejectReason.DUPLICATE_SLOT, "slot 3 ist schon vergeben – ü", 1, 4),
    Goodbye(""),
    Goodbye("the agent stops"),
    Heartbeat({}),
    Heartbeat({"temperature_c": 61.5, "load": 2.0}),
    ClockRequest(-(2**63)),
    ClockReply(1, -2, 2**63 - 1),
    ClockReply(1, 2, 3, -(2**63), 2**64 - 2),
    UnknownSession(),
    Heartbeat({}, 2**64 - 1),
    Heartbeat({"load": 2.0}, 7, Gravity((0.6, -0.8, 0.0), 1.5)),
    Resend(2**64 - 1, ((0, 1), (7, 3), (65535, 65535))),
    Resend(0, WHOLE_FRAME),
    StreamPlan(2, None, 14.5, 1_000_000, 999_999, 0.05, -(2**63)),
    StreamPlan(2, None, 14.5, 1_000_000, 999_999, 0.05, 0, 2**63 - 1, "rig:0123456789abcdef"),
]


def decode(kind: MessageType, values: Any) -> Message:
    return decode_body(kind, msgpack.packb(values))


def hello_values() -> dict[str, Any]:
    """The map that a good hello carries."""
    values = msgpack.unpackb(encode_body(make_hello())[1])
    assert isinstance(values, dict)
    return values


@pytest.mark.parametrize("message", SIMPLE, ids=lambda message: type(message).__name__)
def test_a_message_survives_its_bytes(message: Message) -> None:
    assert decode_body(*encode_body(message)) == message


def test_a_hello_survives_its_bytes() -> None:
    lens = Intrinsics(529.2, 525.6, 328.9, 267.5, dist=(0.26, -0.84, -0.002, 0.001, 0.91))
    sent = make_hello(
        camera_id=None,
        port_path=None,
        model=CameraModel(lens, None, None),
        fps=29.97,
        ciphers=(Cipher.CHACHA20_POLY1305, Cipher.AES_256_GCM),
    )
    received = decode_body(*encode_body(sent))
    assert isinstance(received, Hello)
    assert received.model.to_dict() == sent.model.to_dict()
    names = [name for name in Hello.__slots__ if name != "model"]
    assert [getattr(received, name) for name in names] == [getattr(sent, name) for name in names]


def test_a_hello_is_never_shorter_than_the_answer_it_may_get() -> None:
    shortest = make_hello(
        name="x", serial=None, port_path=None, model=CameraModel(depth=None, T_color_depth=None)
    )
    assert HELLO_OVERHEAD + len(encode_body(shortest)[1]) >= MIN_HELLO_SIZE
    assert 16 + len(encode_body(Reject(RejectReason.MALFORMED, "ü" * 5000))[1]) <= MIN_HELLO_SIZE
    longest = Welcome(2**64 - 1, 255, *(tuple(range(240, 256)),) * 2, 65507, Cipher.CHACHA20_POLY1305)
    assert HELLO_OVERHEAD + len(encode_body(longest)[1]) <= MIN_HELLO_SIZE


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
    assert HELLO_OVERHEAD + len(encode_body(longest)[1]) <= MAX_CONTROL_SIZE


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
        {"ciphers": ()},
    ],
)
def test_a_hello_over_the_limits_is_misuse_at_its_origin(changes: dict[str, Any]) -> None:
    with pytest.raises(LinkUsageError, match="this hello cannot be sent"):
        encode_body(make_hello(**changes))


@pytest.mark.parametrize("key", [key for key in hello_values() if key != "padding"])
@pytest.mark.parametrize("value", [None, True, -1, 1.5, math.inf, "", "\x07", [], [[]], {}, b"x", 2**63])
def test_a_hello_with_a_wrong_value_is_malformed_or_good_never_a_crash(key: str, value: Any) -> None:
    values = {**hello_values(), key: value}
    allowed = {"camera_id": [None], "serial": [None], "port_path": [None], "fps": [1.5]}
    streams = {"color_codecs": [[]], "depth_codecs": [[]]}
    if any(type(value) is type(good) and value == good for good in {**allowed, **streams}.get(key, [])):
        assert isinstance(decode(MessageType.HELLO, values), Hello)
    else:
        with pytest.raises(DataError):
            decode(MessageType.HELLO, values)


@pytest.mark.parametrize("key", [key for key in hello_values() if key != "padding"])
def test_a_hello_without_a_value_is_malformed(key: str) -> None:
    values = hello_values()
    del values[key]
    with pytest.raises(DataError):
        decode(MessageType.HELLO, values)


def test_keys_of_a_later_release_are_ignored() -> None:
    values = {**hello_values(), "zoom": {"steps": 0.25}}
    del values["padding"]
    assert isinstance(decode(MessageType.HELLO, values), Hello)


def test_ciphers_of_a_later_release_are_passed_over_and_one_must_be_known() -> None:
    later = decode(MessageType.HELLO, {**hello_values(), "ciphers": [9, 2, 77, 1]})
    assert isinstance(later, Hello)
    assert later.ciphers == (Cipher.CHACHA20_POLY1305, Cipher.AES_256_GCM)
    with pytest.raises(DataError, match="no cipher that this version knows"):
        decode(MessageType.HELLO, {**hello_values(), "ciphers": [9, 77]})


@pytest.mark.parametrize(
    "values",
    [
        {"session_id": 0},
        {"session_id": 2**64},
        {"camera_id": None},
        {"color_codecs": None},
        {"color_codecs": [0]},
        {"datagram_size": 100},
        {"datagram_size": 65508},
        {"cipher": 0},
        {"cipher": 3},
        {"cipher": [1]},
        {"cipher": None},
    ],
    ids=str,
)
def test_a_welcome_out_of_range_is_malformed(values: dict[str, Any]) -> None:
    good = {
        "session_id": 1,
        "camera_id": 0,
        "color_codecs": [1],
        "depth_codecs": [],
        "datagram_size": 1472,
        "cipher": 1,
    }
    assert isinstance(decode(MessageType.WELCOME, good), Welcome)
    broken = {**good, **values}
    if values == {"session_id": 2**64}:  # beyond MessagePack
        broken["session_id"] = 1.8e19
    with pytest.raises(DataError):
        decode(MessageType.WELCOME, broken)


PLAN: dict[str, Any] = {
    "color_codec": 2,
    "depth_codec": None,
    "fps": 30.0,
    "step_ns": 1000,
    "phase_ns": 999,
    "spread": 1.0,
    "offset_ns": 2**63 - 1,
}


@pytest.mark.parametrize(
    "values",
    [
        *({"color_codec": codec} for codec in (0, 256, [1], True)),
        *({"fps": fps} for fps in (0.0, math.nan, math.inf, 241.0, None)),
        *({"step_ns": step_ns} for step_ns in (0, -1, 1_000_000_001, 1.5)),
        *({"phase_ns": phase_ns} for phase_ns in (1000, -1, None)),
        *({"spread": spread} for spread in (0.0, 1.01, math.nan, None)),
        *({"offset_ns": offset_ns} for offset_ns in (2**63, 0.5, None)),
        *({"offset_uncertainty_ns": uncertainty_ns} for uncertainty_ns in (-1, 2**63, 0.5)),
        *({"rig_clock": clock} for clock in ("", "x" * 33, 5, "red\x1b[31m")),
    ],
    ids=str,
)
def test_a_plan_out_of_range_is_malformed_and_cannot_be_sent(values: dict[str, Any]) -> None:
    assert isinstance(decode(MessageType.PLAN, PLAN), StreamPlan)
    with pytest.raises(DataError):
        decode(MessageType.PLAN, PLAN | values)
    with pytest.raises(LinkUsageError, match="this plan cannot be sent"):
        encode_body(StreamPlan(**(PLAN | values)))


@pytest.mark.parametrize("size", [0, 7, 8, 9, 13, 8 + 4 * MAX_RANGES + 4])
def test_a_resend_holds_one_to_250_ranges(size: int) -> None:
    with pytest.raises(DataError, match="resend body"):
        decode_body(MessageType.RESEND, bytes(size))
    most = Resend(1, ((5, 1),) * MAX_RANGES)
    assert decode_body(*encode_body(most)) == most
    assert SEALED_OVERHEAD + len(encode_body(most)[1]) <= MAX_CONTROL_SIZE
    for ranges in ((), ((5, 1),) * (MAX_RANGES + 1)):
        with pytest.raises(LinkUsageError):
            encode_body(Resend(1, ranges))


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
        decode(MessageType.HEARTBEAT, {"health": health, "frames": 0})
    if isinstance(health, dict):
        with pytest.raises(LinkUsageError, match="heartbeat"):
            encode_body(Heartbeat(health))


@pytest.mark.parametrize("frames", [-1, None, 1.0, True])
def test_a_heartbeat_counts_frames(frames: Any) -> None:
    with pytest.raises(DataError, match="frames"):
        decode(MessageType.HEARTBEAT, {"health": {}, "frames": frames})


def test_an_agent_without_accelerometer_sends_the_heartbeat_that_it_always_sent() -> None:
    _, body = encode_body(Heartbeat({"load": 2.0}, 7))
    assert msgpack.unpackb(body) == {"health": {"load": 2.0}, "frames": 7}


def test_a_heartbeat_without_gravity_or_with_nil_is_one_of_a_camera_that_feels_none() -> None:
    for values in ({}, {"gravity": None}):
        assert decode(MessageType.HEARTBEAT, {"health": {}, "frames": 0, **values}) == Heartbeat({})


@pytest.mark.parametrize("gravity", [[0, 1, 0], {}, {"down": [0, 0, 0], "sigma_deg": 1}, 7], ids=str)
def test_a_heartbeat_with_malformed_gravity_is_malformed(gravity: Any) -> None:
    with pytest.raises(DataError, match="gravity"):
        decode(MessageType.HEARTBEAT, {"health": {}, "frames": 0, "gravity": gravity})


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
    "kind",
    [
        MessageType.HELLO,
        MessageType.WELCOME,
        MessageType.GOODBYE,
        MessageType.HEARTBEAT,
        MessageType.PLAN,
    ],
)
def test_bytes_that_are_no_map_are_malformed(kind: MessageType, body: bytes) -> None:
    with pytest.raises(DataError):
        decode_body(kind, body)


@pytest.mark.parametrize(
    "kind", [MessageType.CLOCK_REQUEST, MessageType.CLOCK_REPLY, MessageType.UNKNOWN_SESSION]
)
def test_a_fixed_body_of_another_size_is_malformed(kind: MessageType) -> None:
    for size in (1, 7, 9, 24, 39, 41):
        with pytest.raises(DataError):
            decode_body(kind, bytes(size))


def test_a_control_message_is_at_most_1200_bytes() -> None:
    widest = make_hello(model=CameraModel(color=Intrinsics(525, 525, 319, 239)), name="n" * 64)
    for message in (
        widest,
        Resend(1, ((5, 1),) * MAX_RANGES),
        Heartbeat({f"{i:032}": 1.0 for i in range(16)}, 2**64 - 1, Gravity((0.6, -0.8, 0.0), 1.5)),
    ):
        assert HELLO_OVERHEAD + len(encode_body(message)[1]) <= MAX_CONTROL_SIZE


def test_a_reject_of_a_later_version_is_readable() -> None:
    text = "nie gehört \x1b[2J".encode()
    body = bytes((99, 2, 7, 123)) + text + b"\xff"
    reject = decode_body(MessageType.REJECT, body)
    assert reject == Reject(RejectReason.OTHER, "nie gehört ?[2J\N{REPLACEMENT CHARACTER}", 2, 7)


@pytest.mark.parametrize("size", [0, 3, 497])
def test_a_reject_that_is_too_short_or_too_long_is_malformed(size: int) -> None:
    with pytest.raises(DataError):
        decode_body(MessageType.REJECT, bytes(size))


def test_texts_are_cut_to_their_limit_between_characters() -> None:
    goodbye = decode_body(*encode_body(Goodbye("ü" * 150 + "\n")))
    assert goodbye == Goodbye("ü" * 100)
