"""Bodies of control messages to and from bytes: strict, bounded (protocol/SPEC.md, sections 4 to 8)."""

import struct
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np

from rig_protocol.camera import CameraModel
from rig_protocol.datagram import (
    MAX_DATAGRAM_SIZE,
    MIN_DATAGRAM_SIZE,
    PREFIX_SIZE,
    MessageType,
)
from rig_protocol.errors import DataError, LinkUsageError
from rig_protocol.gravity import Gravity
from rig_protocol.message_fields import (
    Fields,
    cipher,
    ciphers,
    codec_ids,
    control_value,
    flag,
    gauges,
    integer,
    number,
    optional,
    text,
    unpack_fixed,
    unpack_map,
)
from rig_protocol.messages import (
    ClockReply,
    ClockRequest,
    Control,
    ControlResult,
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
from rig_protocol.security import PUBLIC_KEY_SIZE, TAG_SIZE

MAX_CONTROL_SIZE = MIN_DATAGRAM_SIZE
# No answer to a stranger's hello is larger than the hello: SPEC section 5, for all versions.
MIN_HELLO_SIZE = MAX_REJECT_SIZE = 512
# Prefix, public key and tag around the body of a hello.
HELLO_OVERHEAD = PREFIX_SIZE + PUBLIC_KEY_SIZE + TAG_SIZE
MAX_NAME_BYTES = 64
MAX_TEXT_BYTES = 200
MAX_CONTROL_NAME_BYTES = 32
MAX_CONTROL_WORD_BYTES = 64
MAX_CONTROL_NUMBER = 2**32 - 1
MAX_CODECS = 16
MAX_GAUGES = 16
MAX_GAUGE_NAME_BYTES = 32
MIN_FPS, MAX_FPS = 0.1, 240.0
# 4 bytes each; a frame with more gaps is asked for in several messages.
MAX_RANGES = 250
MAX_CLOCK_NAME_BYTES = 32
MIN_SPREAD = 0.05
_MAX_STEP_NS = 1_000_000_000

_REJECT = struct.Struct("<BBBx")
_CLOCK_REQUEST = struct.Struct("<q")
_CLOCK_REPLY = struct.Struct("<qqqqQ")
_RESEND = struct.Struct("<Q")
_UNDISCIPLINED = 2**64 - 1
_RANGE = np.dtype([("first", "<u2"), ("count", "<u2")])


def encode_body(message: Message) -> tuple[MessageType, bytes]:
    """Type and body of a message; LinkUsageError when it breaks a limit of the protocol."""
    message_type, write = _WRITERS[type(message)]
    body = write(message)
    size = len(body) + HELLO_OVERHEAD  # that of a hello is the largest
    if size > MAX_CONTROL_SIZE:
        raise LinkUsageError(
            f"{message_type.name} takes {size} bytes, at most {MAX_CONTROL_SIZE} are allowed"
        )
    return message_type, body


def decode_body(message_type: int, body: bytes) -> Message:
    """The message of a body; DataError says what breaks SPEC sections 4, 5, 7 or 8."""
    return _READERS[MessageType(message_type)](body)


def decode_hello(body: bytes) -> Hello:
    """The hello of an authentic body; DataError as `decode_body`."""
    return _read_hello(body)


def decode_welcome(body: bytes) -> Welcome:
    """The welcome of an authentic body; DataError as `decode_body`."""
    return _read_welcome(body)


def printable(text: str) -> str:
    """Text of a stranger made safe for a terminal."""
    return "".join(character if character.isprintable() else "?" for character in text)


def shortened(text: str, limit: int) -> str:
    """Printable text of at most `limit` bytes in UTF-8."""
    return printable(text).encode()[:limit].decode(errors="ignore")


# ---- HELLO


def _write_hello(hello: Hello) -> bytes:
    _check_hello(hello)
    values = {
        "name": hello.name,
        "camera_id": hello.camera_id,
        "serial": hello.serial,
        "port_path": hello.port_path,
        "model": hello.model.to_dict(),
        "color_codecs": list(hello.color_codecs),
        "depth_codecs": list(hello.depth_codecs),
        "fps": hello.fps,
        "software": hello.software,
        "ciphers": [int(one) for one in hello.ciphers],
        **_controls_key(hello.controls),
        "padding": b"",
    }
    missing = MIN_HELLO_SIZE - HELLO_OVERHEAD - len(msgpack.packb(values))
    values["padding"] = bytes(max(0, missing))
    return bytes(msgpack.packb(values))


def _controls_key(controls: bool) -> Fields:
    """A later key of this version: absent where the feature is off."""
    return {"controls": True} if controls else {}


def _check_hello(hello: Hello) -> None:
    """A hello that the other end would call malformed is a mistake of this end."""
    values = {name: getattr(hello, name) for name in ("name", "camera_id", "serial", "port_path", "software")}
    codecs = {
        "color_codecs": list(hello.color_codecs),
        "depth_codecs": list(hello.depth_codecs),
        "ciphers": [int(one) for one in hello.ciphers],
    }
    try:
        _hello_of({**values, **codecs, "fps": hello.fps}, hello.model)
    except DataError as error:
        raise LinkUsageError(f"this hello cannot be sent: {error}") from error


def _read_hello(body: bytes) -> Hello:
    values = unpack_map(body)
    with np.errstate(all="ignore"):  # a hostile matrix overflows; it is refused just after
        model = CameraModel.from_dict(values.get("model", {}))
    return _hello_of(values, model)


def _hello_of(values: Fields, model: CameraModel) -> Hello:
    return Hello(
        name=text(values, "name", MAX_NAME_BYTES),
        camera_id=optional(integer, values, "camera_id", 0, 255),
        serial=optional(text, values, "serial", MAX_NAME_BYTES),
        port_path=optional(text, values, "port_path", MAX_NAME_BYTES),
        model=model,
        color_codecs=codec_ids(values, "color_codecs", MAX_CODECS),
        depth_codecs=codec_ids(values, "depth_codecs", MAX_CODECS),
        fps=number(values, "fps", MIN_FPS, MAX_FPS),
        software=text(values, "software", MAX_NAME_BYTES),
        ciphers=ciphers(values, "ciphers"),
        controls=flag(values, "controls"),
    )


# ---- WELCOME


def _write_welcome(welcome: Welcome) -> bytes:
    return bytes(
        msgpack.packb(
            {
                "session_id": welcome.session_id,
                "camera_id": welcome.camera_id,
                "color_codecs": list(welcome.color_codecs),
                "depth_codecs": list(welcome.depth_codecs),
                "datagram_size": welcome.datagram_size,
                "cipher": int(welcome.cipher),
                **_controls_key(welcome.controls),
            }
        )
    )


def _read_welcome(body: bytes) -> Welcome:
    values = unpack_map(body)
    return Welcome(
        session_id=integer(values, "session_id", 1, 2**64 - 1),
        camera_id=integer(values, "camera_id", 0, 255),
        color_codecs=codec_ids(values, "color_codecs", MAX_CODECS),
        depth_codecs=codec_ids(values, "depth_codecs", MAX_CODECS),
        datagram_size=integer(values, "datagram_size", MIN_DATAGRAM_SIZE, MAX_DATAGRAM_SIZE),
        cipher=cipher(values.get("cipher")),
        controls=flag(values, "controls"),
    )


# ---- REJECT: the same bytes in all versions


def _write_reject(reject: Reject) -> bytes:
    head = _REJECT.pack(reject.reason.value, reject.lowest_version, reject.highest_version)
    return head + shortened(reject.text, MAX_REJECT_SIZE - PREFIX_SIZE - _REJECT.size).encode()


def _read_reject(body: bytes) -> Reject:
    if not _REJECT.size <= len(body) <= MAX_REJECT_SIZE - PREFIX_SIZE:
        raise DataError(f"a reject body of {len(body)} bytes")
    code, lowest, highest = _REJECT.unpack_from(body)
    known = {reason.value: reason for reason in RejectReason}
    text = printable(body[_REJECT.size :].decode(errors="replace"))
    return Reject(known.get(code, RejectReason.OTHER), text, lowest, highest)


# ---- the short ones


def _write_goodbye(goodbye: Goodbye) -> bytes:
    return bytes(msgpack.packb({"text": shortened(goodbye.text, MAX_TEXT_BYTES)}))


def _read_goodbye(body: bytes) -> Goodbye:
    return Goodbye(text(unpack_map(body), "text", MAX_TEXT_BYTES, shortest=0))


def _write_heartbeat(heartbeat: Heartbeat) -> bytes:
    try:
        health = gauges({"health": dict(heartbeat.health)}, "health", MAX_GAUGES, MAX_GAUGE_NAME_BYTES)
    except DataError as error:
        raise LinkUsageError(f"this heartbeat cannot be sent: {error}") from error
    gravity = {} if heartbeat.gravity is None else {"gravity": heartbeat.gravity.to_dict()}
    return bytes(msgpack.packb({"health": health, "frames": heartbeat.frames, **gravity}))


def _read_heartbeat(body: bytes) -> Heartbeat:
    values = unpack_map(body)
    health = gauges(values, "health", MAX_GAUGES, MAX_GAUGE_NAME_BYTES)
    felt = values.get("gravity")
    gravity = None if felt is None else Gravity.from_dict(felt)
    return Heartbeat(health, integer(values, "frames", 0, 2**64 - 1), gravity)


def _read_clock_request(body: bytes) -> ClockRequest:
    return ClockRequest(*unpack_fixed(_CLOCK_REQUEST, body))


def _write_clock_reply(reply: ClockReply) -> bytes:
    error_ns = _UNDISCIPLINED if reply.wall_error_ns is None else reply.wall_error_ns
    return _CLOCK_REPLY.pack(reply.t1_ns, reply.t2_ns, reply.t3_ns, reply.wall_minus_agent_ns, error_ns)


def _read_clock_reply(body: bytes) -> ClockReply:
    t1_ns, t2_ns, t3_ns, wall_minus_agent_ns, error_ns = unpack_fixed(_CLOCK_REPLY, body)
    known = None if error_ns == _UNDISCIPLINED else error_ns
    return ClockReply(t1_ns, t2_ns, t3_ns, wall_minus_agent_ns, known)


def _read_unknown_session(body: bytes) -> UnknownSession:
    if body:
        raise DataError(f"{len(body)} bytes after an UNKNOWN_SESSION")
    return UnknownSession()


# ---- RESEND


def _write_resend(resend: Resend) -> bytes:
    if not 0 < len(resend.ranges) <= MAX_RANGES:
        raise LinkUsageError(f"{len(resend.ranges)} ranges in a resend, 1 to {MAX_RANGES} are allowed")
    return _RESEND.pack(resend.frame_number) + np.array(resend.ranges, "<u2").tobytes()


def _read_resend(body: bytes) -> Resend:
    size = len(body) - _RESEND.size
    if not 0 < size <= MAX_RANGES * _RANGE.itemsize or size % _RANGE.itemsize:
        raise DataError(f"a resend body of {len(body)} bytes")
    (frame_number,) = _RESEND.unpack_from(body)
    ranges = np.frombuffer(body, _RANGE, offset=_RESEND.size)
    return Resend(frame_number, tuple((int(first), int(count)) for first, count in ranges))


# ---- PLAN

_LATER_KEYS = ("offset_uncertainty_ns", "rig_clock")  # absent where nobody knows


def _write_plan(plan: StreamPlan) -> bytes:
    values = {name: getattr(plan, name) for name in StreamPlan.__slots__}
    values = {name: value for name, value in values.items() if value is not None or name not in _LATER_KEYS}
    try:
        _plan_of(values)
    except DataError as error:
        raise LinkUsageError(f"this plan cannot be sent: {error}") from error
    return bytes(msgpack.packb(values))


def _read_plan(body: bytes) -> StreamPlan:
    return _plan_of(unpack_map(body))


def _plan_of(values: Fields) -> StreamPlan:
    step_ns = integer(values, "step_ns", 1, _MAX_STEP_NS)
    values = dict.fromkeys(_LATER_KEYS) | dict(values)
    return StreamPlan(
        color_codec=optional(integer, values, "color_codec", 1, 255),
        depth_codec=optional(integer, values, "depth_codec", 1, 255),
        fps=number(values, "fps", MIN_FPS, MAX_FPS),
        step_ns=step_ns,
        phase_ns=integer(values, "phase_ns", 0, step_ns - 1),
        spread=number(values, "spread", MIN_SPREAD, 1.0),
        offset_ns=integer(values, "offset_ns", -(2**63), 2**63 - 1),
        offset_uncertainty_ns=optional(integer, values, "offset_uncertainty_ns", 0, 2**63 - 1),
        rig_clock=optional(text, values, "rig_clock", MAX_CLOCK_NAME_BYTES),
    )


# ---- CONTROL


def _write_control(control: Control) -> bytes:
    values = {name: getattr(control, name) for name in Control.__slots__}
    try:
        _control_of(values)
    except DataError as error:
        raise LinkUsageError(f"this control cannot be sent: {error}") from error
    return bytes(msgpack.packb(values))


def _read_control(body: bytes) -> Control:
    return _control_of(unpack_map(body))


def _control_of(values: Fields) -> Control:
    return Control(
        number=integer(values, "number", 1, MAX_CONTROL_NUMBER),
        name=text(values, "name", MAX_CONTROL_NAME_BYTES),
        value=control_value(values, "value", MAX_CONTROL_WORD_BYTES),
    )


def _write_control_result(result: ControlResult) -> bytes:
    said = shortened(result.text, MAX_TEXT_BYTES)
    return bytes(msgpack.packb({"number": result.number, "done": result.done, "text": said}))


def _read_control_result(body: bytes) -> ControlResult:
    values = unpack_map(body)
    return ControlResult(
        number=integer(values, "number", 1, MAX_CONTROL_NUMBER),
        done=flag(values, "done", optional=False),
        text=text(values, "text", MAX_TEXT_BYTES, shortest=0),
    )


_WRITERS: dict[type[Message], tuple[MessageType, Callable[[Any], bytes]]] = {
    Hello: (MessageType.HELLO, _write_hello),
    Welcome: (MessageType.WELCOME, _write_welcome),
    Reject: (MessageType.REJECT, _write_reject),
    Goodbye: (MessageType.GOODBYE, _write_goodbye),
    Heartbeat: (MessageType.HEARTBEAT, _write_heartbeat),
    ClockRequest: (MessageType.CLOCK_REQUEST, lambda m: _CLOCK_REQUEST.pack(m.t1_ns)),
    ClockReply: (MessageType.CLOCK_REPLY, _write_clock_reply),
    UnknownSession: (MessageType.UNKNOWN_SESSION, lambda _: b""),
    Resend: (MessageType.RESEND, _write_resend),
    StreamPlan: (MessageType.PLAN, _write_plan),
    Control: (MessageType.CONTROL, _write_control),
    ControlResult: (MessageType.CONTROL_RESULT, _write_control_result),
}

_READERS: dict[MessageType, Callable[[bytes], Message]] = {
    MessageType.HELLO: _read_hello,
    MessageType.WELCOME: _read_welcome,
    MessageType.REJECT: _read_reject,
    MessageType.GOODBYE: _read_goodbye,
    MessageType.HEARTBEAT: _read_heartbeat,
    MessageType.CLOCK_REQUEST: _read_clock_request,
    MessageType.CLOCK_REPLY: _read_clock_reply,
    MessageType.UNKNOWN_SESSION: _read_unknown_session,
    MessageType.RESEND: _read_resend,
    MessageType.PLAN: _read_plan,
    MessageType.CONTROL: _read_control,
    MessageType.CONTROL_RESULT: _read_control_result,
}
