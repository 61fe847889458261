"""Whether an .oni recording is whole, before OpenNI2's player gets it.

The player stops without a word where a file is torn, and follows lengths and names in it blindly, into a
crash if they are wrong. A file is a header and records. A record is "NIR\\0", type, stream, bytes of header
and fields, bytes of payload, position of the record that it undoes; then the fields and the payload. The
last record says that the recorder closed the file.
"""

import os
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

from rig_protocol.errors import ConfigurationError, DataError

_FILE_HEADER = struct.Struct("<4s16xI")  # ..., the highest number of a stream
_MOST_STREAMS = 64  # the player makes room for as many as the header says
_FILE_MAGIC = b"NI10"
_HEADER = struct.Struct("<4sIIIIQ")
_MAGIC = b"NIR\0"
_LENGTH = struct.Struct("<I")
_PROPERTIES = range(3, 7)  # integer, real, string, any: a name and a value, each behind its length
_DATA, _END, _STREAM = 10, 11, 13
_LONGEST_FIELDS = 1 << 16
_UNCOMPRESSED = b"NONE"
_FRAME_SIZE = b"oniRequiredFrameSize\0"


class _Record(NamedTuple):
    kind: int
    stream: int
    fields: bytes
    payload_bytes: int


@dataclass(slots=True)
class _Contents:
    """What the records so far say."""

    streams: int
    images: int = 0
    uncompressed: set[int] = field(default_factory=set)
    frame_bytes: dict[int, int] = field(default_factory=dict)


def check_recording(path: Path) -> None:
    """ConfigurationError for a file that cannot be read, DataError for one that is foreign or torn."""
    try:
        with path.open("rb") as file:
            _check(path, file)
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read: {error.strerror}") from error


def _check(path: Path, file: BinaryIO) -> None:
    header = file.read(_FILE_HEADER.size)
    if len(header) < _FILE_HEADER.size or not header.startswith(_FILE_MAGIC):
        raise DataError(f"{path} is no OpenNI recording: it does not begin with {_FILE_MAGIC.decode()}")
    contents = _Contents(streams=_FILE_HEADER.unpack(header)[1])
    length = os.fstat(file.fileno()).st_size
    while True:
        position = file.tell()
        record = _next_record(file, length)
        if record is None or not _takes(contents, record):
            raise DataError(
                f"{path} is torn or damaged at byte {position} of {length}: "
                "play an intact copy, or record anew"
            )
        if record.kind == _END:
            break
    if contents.images == 0:
        raise DataError(f"{path} holds no images")


def _next_record(file: BinaryIO, length: int) -> _Record | None:
    """The record here, the file then standing behind it; None when it is none or not whole."""
    position = file.tell()
    header = file.read(_HEADER.size)
    if len(header) < _HEADER.size:
        return None
    magic, kind, stream, header_bytes, payload_bytes, _ = _HEADER.unpack(header)
    if magic != _MAGIC or not _HEADER.size <= header_bytes <= _HEADER.size + _LONGEST_FIELDS:
        return None
    if position + header_bytes + payload_bytes > length:
        return None
    fields = file.read(header_bytes - _HEADER.size)
    file.seek(payload_bytes, os.SEEK_CUR)
    return _Record(kind, stream, fields, payload_bytes)


def _takes(contents: _Contents, record: _Record) -> bool:
    """Note what the record says; False when it contradicts itself or what was said before."""
    if record.stream > contents.streams or contents.streams > _MOST_STREAMS:
        return False
    if record.kind in _PROPERTIES:
        read = _property(record.fields)
        if read and read[0] == _FRAME_SIZE:
            contents.frame_bytes[record.stream] = int.from_bytes(read[1], "little")
        return read is not None
    if record.kind == _STREAM:
        if _UNCOMPRESSED in record.fields:
            contents.uncompressed.add(record.stream)
        return _name(record.fields) is not None
    if record.kind == _DATA:
        contents.images += 1
        stated = contents.frame_bytes.get(record.stream)
        return record.stream not in contents.uncompressed or record.payload_bytes == stated
    return True


def _property(fields: bytes) -> tuple[bytes, bytes] | None:
    """Its name and value; None unless both fill the fields exactly."""
    name = _name(fields)
    if name is None:
        return None
    rest = fields[_LENGTH.size + len(name) :]
    if len(rest) < _LENGTH.size or _LENGTH.unpack_from(rest)[0] != len(rest) - _LENGTH.size:
        return None
    return name, rest[_LENGTH.size :]


def _name(fields: bytes) -> bytes | None:
    """A name with its length before it and a zero behind; None unless it is one, in ASCII."""
    if len(fields) < _LENGTH.size:
        return None
    name = fields[_LENGTH.size :][: _LENGTH.unpack_from(fields)[0]]
    whole = len(name) == _LENGTH.unpack_from(fields)[0] and name.find(b"\0") == len(name) - 1
    return name if name and whole and name.isascii() else None
