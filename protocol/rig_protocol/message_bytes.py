"""Control messages to and from bytes: strict, bounded (protocol/SPEC.md, sections 2, 4, 5 and 8)."""

import struct
import zlib
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np

from rig_protocol.camera import CameraModel
from rig_protocol.datagram import (
    MAX_DATAGRAM_SIZE,
    MIN_DATAGRAM_SIZE,
    PREFIX_SIZE,
    Buffer,
    MessageType,
    Prefix,
    pack_prefix,
)
from rig_protocol.errors import DataError, LinkUsageError
from rig_protocol.message_fields import (
    Fields,
    codec_ids,
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
    Goodbye,
    Heartbeat,
    Hello,
    Message,
    Reject,
    RejectReason,
    UnknownSession,
    Welcome,
)

MAX_CONTROL_SIZE = MIN_DATAGRAM_SIZE
# No answer to a stranger's hello is larger than the hello: SPEC section 5, for all versions.
MIN_HELLO_SIZE = MAX_REJECT_SIZE = 512
MAX_NAME_BYTES = 64
MAX_TEXT_BYTES = 200
MAX_CODECS = 16
MAX_GAUGES = 16
MAX_GAUGE_NAME_BYTES = 32
MIN_FPS, MAX_FPS = 0.1, 240.0

_REJECT = struct.Struct("<BBBx")
_CLOCK_REQUEST = struct.Struct("<q")
_CLOCK_REPLY = struct.Struct("<qqq")
# zlib.crc32 of the datagram without its crc field, which lies here.
_CRC_START, _CRC_END = 4, 8


def encode_message(message: Message, id_: int) -> bytes:
    """The datagram of a control message; LinkUsageError when it breaks a limit of the protocol."""
    message_type, write = _WRITERS[type(message)]
    body = write(message)
    size = PREFIX_SIZE + len(body)
    if size > MAX_CONTROL_SIZE:
        raise LinkUsageError(
            f"{message_type.name} takes {size} bytes, at most {MAX_CONTROL_SIZE} are allowed"
        )
    datagram = pack_prefix(message_type, 0, id_) + body
    return datagram[:_CRC_START] + control_crc(datagram).to_bytes(4, "little") + datagram[_CRC_END:]


def decode_message(prefix: Prefix, datagram: Buffer) -> Message:
    """The message of a datagram whose crc holds; DataError says what breaks SPEC sections 4, 5 or 8."""
    if len(datagram) > MAX_CONTROL_SIZE:
        raise DataError(f"a control message of {len(datagram)} bytes, at most {MAX_CONTROL_SIZE} are allowed")
    return _READERS[MessageType(prefix.type)](bytes(datagram[PREFIX_SIZE:]))


def decode_hello(prefix: Prefix, datagram: Buffer) -> Hello:
    """The hello of a datagram whose prefix says HELLO; DataError as `decode_message`."""
    message = decode_message(prefix, datagram)
    if not isinstance(message, Hello):
        raise LinkUsageError(f"type {prefix.type} is no hello")
    return message


def control_crc(datagram: Buffer) -> int:
    """CRC-32 of a control message: of everything but its crc field."""
    return zlib.crc32(datagram[_CRC_END:], zlib.crc32(datagram[:_CRC_START]))


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
        "padding": b"",
    }
    missing = MIN_HELLO_SIZE - PREFIX_SIZE - len(msgpack.packb(values))
    values["padding"] = bytes(max(0, missing))
    return bytes(msgpack.packb(values))


def _check_hello(hello: Hello) -> None:
    """A hello that the other end would call malformed is a mistake of this end."""
    values = {name: getattr(hello, name) for name in ("name", "camera_id", "serial", "port_path", "software")}
    codecs = {"color_codecs": list(hello.color_codecs), "depth_codecs": list(hello.depth_codecs)}
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
    hello = Hello(
        name=text(values, "name", MAX_NAME_BYTES),
        camera_id=optional(integer, values, "camera_id", 0, 255),
        serial=optional(text, values, "serial", MAX_NAME_BYTES),
        port_path=optional(text, values, "port_path", MAX_NAME_BYTES),
        model=model,
        color_codecs=codec_ids(values, "color_codecs", MAX_CODECS),
        depth_codecs=codec_ids(values, "depth_codecs", MAX_CODECS),
        fps=number(values, "fps", MIN_FPS, MAX_FPS),
        software=text(values, "software", MAX_NAME_BYTES),
    )
    if not hello.color_codecs and not hello.depth_codecs:
        raise DataError("neither color_codecs nor depth_codecs offers a stream")
    return hello


# ---- WELCOME


def _write_welcome(welcome: Welcome) -> bytes:
    return bytes(
        msgpack.packb(
            {
                "session_id": welcome.session_id,
                "camera_id": welcome.camera_id,
                "color_codec": welcome.color_codec,
                "depth_codec": welcome.depth_codec,
                "datagram_size": welcome.datagram_size,
            }
        )
    )


def _read_welcome(body: bytes) -> Welcome:
    values = unpack_map(body)
    return Welcome(
        session_id=integer(values, "session_id", 1, 2**64 - 1),
        camera_id=integer(values, "camera_id", 0, 255),
        color_codec=optional(integer, values, "color_codec", 1, 255),
        depth_codec=optional(integer, values, "depth_codec", 1, 255),
        datagram_size=integer(values, "datagram_size", MIN_DATAGRAM_SIZE, MAX_DATAGRAM_SIZE),
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
    return bytes(msgpack.packb({"health": health}))


def _read_heartbeat(body: bytes) -> Heartbeat:
    return Heartbeat(gauges(unpack_map(body), "health", MAX_GAUGES, MAX_GAUGE_NAME_BYTES))


def _read_clock_request(body: bytes) -> ClockRequest:
    return ClockRequest(*unpack_fixed(_CLOCK_REQUEST, body))


def _read_clock_reply(body: bytes) -> ClockReply:
    return ClockReply(*unpack_fixed(_CLOCK_REPLY, body))


def _read_unknown_session(body: bytes) -> UnknownSession:
    if body:
        raise DataError(f"{len(body)} bytes after an UNKNOWN_SESSION")
    return UnknownSession()


_WRITERS: dict[type[Message], tuple[MessageType, Callable[[Any], bytes]]] = {
    Hello: (MessageType.HELLO, _write_hello),
    Welcome: (MessageType.WELCOME, _write_welcome),
    Reject: (MessageType.REJECT, _write_reject),
    Goodbye: (MessageType.GOODBYE, _write_goodbye),
    Heartbeat: (MessageType.HEARTBEAT, _write_heartbeat),
    ClockRequest: (MessageType.CLOCK_REQUEST, lambda m: _CLOCK_REQUEST.pack(m.t1_ns)),
    ClockReply: (MessageType.CLOCK_REPLY, lambda m: _CLOCK_REPLY.pack(m.t1_ns, m.t2_ns, m.t3_ns)),
    UnknownSession: (MessageType.UNKNOWN_SESSION, lambda _: b""),
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
}
