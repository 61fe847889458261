"""A frame as one unit of bytes: frame header, colour payload, depth payload (protocol/SPEC.md, section 3)."""

import struct

from rig_protocol.datagram import Buffer, FragmentHeader
from rig_protocol.errors import DataError, LinkUsageError
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.security import TAG_SIZE

_HEADER = struct.Struct("<QqIBBBxII")
FRAME_HEADER_SIZE = _HEADER.size

# 1280×1024 Bayer and raw 16-bit depth, unencoded, are 1.9 MB.
MAX_UNIT_SIZE = 2 * 1024 * 1024
# On the wire a unit is sealed.
MIN_SEALED_SIZE = FRAME_HEADER_SIZE + TAG_SIZE
MAX_SEALED_SIZE = MAX_UNIT_SIZE + TAG_SIZE

_DAMAGED, _REGISTERED, _HAS_COLOR, _HAS_DEPTH = 1, 2, 4, 8
_ALL_FLAGS = _DAMAGED | _REGISTERED | _HAS_COLOR | _HAS_DEPTH
_MAX_U32 = 2**32 - 1

# The header fields that the seal binds: session, number, unit size, payload size.
_PLACE = struct.Struct("<QQIH")


def pack_unit(frame: EncodedFrame) -> bytes:
    """The unit of a frame; LinkUsageError when it breaks a limit of the protocol."""
    color, depth = frame.color, frame.depth
    flags = (
        (_DAMAGED if frame.damaged else 0)
        | (_REGISTERED if frame.depth_frame == "color" else 0)
        | (_HAS_COLOR if color else 0)
        | (_HAS_DEPTH if depth else 0)
    )
    color_data, depth_data = color.data if color else b"", depth.data if depth else b""
    size = FRAME_HEADER_SIZE + len(color_data) + len(depth_data)
    if size > MAX_UNIT_SIZE:
        raise LinkUsageError(f"a frame of {size} bytes, at most {MAX_UNIT_SIZE} are allowed")
    try:
        header = _HEADER.pack(
            frame.sequence,
            frame.timestamp_ns,
            min(frame.uncertainty_ns, _MAX_U32),
            flags,
            color.codec_id if color else 0,
            depth.codec_id if depth else 0,
            len(color_data),
            len(depth_data),
        )
    except struct.error as error:
        raise LinkUsageError(f"frame {frame.sequence} does not fit its header: {error}") from error
    return b"".join((header, color_data, depth_data))


def parse_unit(unit: bytes, camera_id: int) -> EncodedFrame:
    """The frame of a unit, stamped in agent time; DataError for what SPEC section 3 does not allow.

    The payloads are views of the unit, not copies.
    """
    if len(unit) < FRAME_HEADER_SIZE:
        raise DataError(f"a unit of {len(unit)} bytes has no frame header")
    sequence, time_ns, uncertainty_ns, flags, color_codec, depth_codec, color_size, depth_size = (
        _HEADER.unpack_from(unit)
    )
    if len(unit) != FRAME_HEADER_SIZE + color_size + depth_size or flags & ~_ALL_FLAGS:
        raise DataError(f"a unit of {len(unit)} bytes with flags {flags:#x} contradicts its frame header")
    body = memoryview(unit)[FRAME_HEADER_SIZE:]
    return EncodedFrame(
        camera_id=camera_id,
        sequence=sequence,
        timestamp_ns=time_ns,
        uncertainty_ns=uncertainty_ns,
        color=_payload(flags & _HAS_COLOR, color_codec, body[:color_size]),
        depth=_payload(flags & _HAS_DEPTH, depth_codec, body[color_size:]),
        depth_frame="color" if flags & _REGISTERED else "depth",
        damaged=bool(flags & _DAMAGED),
    )


def sealed_place(header: FragmentHeader) -> bytes:
    """What the seal of a unit binds beside its content: its place on the wire."""
    return _PLACE.pack(header.session_id, header.frame_number, header.unit_size, header.payload_size)


def leading_seal(sealed: Buffer) -> int:
    """What the fragments of a sealed unit carry of its tag."""
    return int.from_bytes(sealed[-TAG_SIZE : 4 - TAG_SIZE], "little")


def _payload(present: int, codec_id: int, data: memoryview) -> Payload | None:
    if bool(present) != bool(codec_id) or (data and not present):
        raise DataError("a payload without its flag or codec, or the other way round")
    return Payload(codec_id, data) if present else None
