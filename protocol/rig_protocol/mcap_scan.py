"""MCAP files read record after record: a torn end and hostile lengths cost nothing but what they touch.

The `mcap` library's readers trust the lengths inside a record and want a sound end. Here every record is
bounded before it is read; its content is parsed by the library.
"""

import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from rig_protocol.errors import ConfigurationError, DataError

MAGIC = b"\x89MCAP0\r\n"
# Our chunks end soon after 4 MiB; other programs that rewrite a file may make larger ones.
MAX_RECORD_BYTES = 64 << 20
MAX_CHUNKS = 1 << 20
_RECORD = struct.Struct("<BQ")
_CHUNK_TIMES = struct.Struct("<QQ")
_CHUNK_HEAD = struct.Struct("<QQQII")  # times, size and check sum of the content, length of its compression
_CONTENT_LENGTH = struct.Struct("<Q")
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _ATTACHMENT, _METADATA, _DATA_END = 2, 3, 4, 5, 6, 9, 12, 15
_MESSAGE_INDEX = 7
_MAX_INDEX_BYTES = 1 << 20  # of one topic in one chunk
_MAX_SMALL_BYTES = 64 << 20  # channels, attachments and metadata of one file


@dataclass(frozen=True, slots=True)
class ChunkPlace:
    """Where a chunk's content stands, and the times of its first and last message."""

    offset: int
    length: int
    start_ns: int
    end_ns: int


@dataclass(slots=True)
class Contents:
    """What a file holds, without the messages. `sound`: it was finished in order.

    `topics`: of the channels that are known: those of the summary, or more once the chunks were read. The
    last attachment of a name counts.
    """

    chunks: list[ChunkPlace] = field(default_factory=list)
    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    topics: dict[int, str] = field(default_factory=dict)
    sound: bool = False


def scan(path: Path) -> Contents:
    """Look through a file, leaving out what its chunks hold.

    ConfigurationError when it cannot be read, DataError when it is no MCAP file or out of reason.
    """
    contents, small = Contents(), 0
    with open_recording(path) as file:
        size = path.stat().st_size
        if file.read(len(MAGIC)) != MAGIC:
            raise DataError(f"{path} is no MCAP file: a recording begins with the bytes 89 MCAP0")
        for opcode, offset, length in _records(file, size):
            if opcode == _CHUNK and length >= _CHUNK_TIMES.size:
                start_ns, end_ns = sorted(_CHUNK_TIMES.unpack(file.read(_CHUNK_TIMES.size)))
                contents.chunks.append(ChunkPlace(offset, length, start_ns, end_ns))
            elif opcode in (_ATTACHMENT, _METADATA, _CHANNEL):
                small += _RECORD.size + length
                if small > _MAX_SMALL_BYTES:
                    raise DataError(f"{path} has attachments of more than {_MAX_SMALL_BYTES} bytes")
                _take_small(contents, opcode, file.read(length), path)
            if len(contents.chunks) > MAX_CHUNKS:
                raise DataError(f"{path} has more than {MAX_CHUNKS} chunks, which no recording has")
            if opcode == _FOOTER:
                file.seek(offset + length)
                contents.sound = file.read(len(MAGIC)) == MAGIC
                break
    return contents


def open_recording(path: Path) -> BinaryIO:
    """The file to read; ConfigurationError when there is none."""
    try:
        return path.open("rb")
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read: {error.strerror}") from error


def chunk_messages(
    file: BinaryIO, place: ChunkPlace, topics: dict[int, str], path: Path
) -> Iterator[tuple[str, int, bytes]]:
    """Topic, time and data of the messages of a chunk; channels that it declares go into `topics`.

    DataError when it is damaged; nothing of it has been given then.
    """
    file.seek(place.offset)
    content = _chunk_content(_bounded(file, place.length, path), path)
    stream = BytesIO(content)
    for opcode, _, length in _records(stream, len(content)):
        if opcode == _CHANNEL:
            topics |= _topic(stream.read(length), path)
        elif opcode == _MESSAGE:
            message = _parsed("Message", stream.read(length), path, length)
            if message.channel_id in topics:
                yield topics[message.channel_id], message.log_time, message.data


def topic_messages(
    file: BinaryIO, place: ChunkPlace, topic: str, topics: dict[int, str], path: Path
) -> list[bytes]:
    """The messages of one topic in a chunk, found by its message indexes: the check sum is not looked at.

    Where indexes are absent, do not fit or name an unknown channel, the chunk is read by `chunk_messages`.
    """
    try:
        found, room = [], min(place.length, MAX_RECORD_BYTES)
        for offset in _indexed_offsets(file, place, topic, topics, path):
            found.append(_message_at(file, place, offset, topic, topics, path))
            room -= len(found[-1])
            if room < 0:  # messages within messages
                raise DataError(f"{path} has message indexes that do not fit")
    except DataError:
        return [data for name, _, data in chunk_messages(file, place, topics, path) if name == topic]
    return found


def _indexed_offsets(
    file: BinaryIO, place: ChunkPlace, topic: str, topics: dict[int, str], path: Path
) -> list[int]:
    """Where in the file the topic's messages begin; DataError where the indexes do not tell."""
    file.seek(place.offset)
    head = file.read(_CHUNK_HEAD.size).ljust(_CHUNK_HEAD.size, b"\0")
    first, packed = place.offset + _CHUNK_HEAD.size + _CONTENT_LENGTH.size, _CHUNK_HEAD.unpack(head)[-1]
    offsets: set[int] = set()
    file.seek(place.offset + place.length)
    for count, (opcode, _, length) in enumerate(_records(file, os.fstat(file.fileno()).st_size)):
        if opcode != _MESSAGE_INDEX and count:  # it follows the last index: they are all there
            return sorted(first + offset for offset in offsets)
        if opcode != _MESSAGE_INDEX:
            break
        data = file.read(min(length, _MAX_INDEX_BYTES))
        name = topics.get(int.from_bytes(data[:2], "little"))
        if name is None or (name == topic and packed):
            break
        if name == topic:
            offsets |= {offset for _, offset in _parsed("MessageIndex", data, path).records}
    raise DataError(f"{path} has a chunk that is not indexed")


def _message_at(
    file: BinaryIO, place: ChunkPlace, offset: int, topic: str, topics: dict[int, str], path: Path
) -> bytes:
    room = place.offset + place.length - offset - _RECORD.size
    if room >= 0:
        file.seek(offset)
        opcode, length = _RECORD.unpack(file.read(_RECORD.size))
        if opcode == _MESSAGE and length <= min(room, MAX_RECORD_BYTES):
            message = _parsed("Message", file.read(length), path, length)
            if topics.get(message.channel_id) == topic:
                return bytes(message.data)
    raise DataError(f"{path} has message indexes that do not fit")


def _records(file: BinaryIO, size: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, offset of the content and its length, of every record that is whole."""
    offset = file.tell()
    while len(header := file.read(_RECORD.size)) == _RECORD.size:
        opcode, length = _RECORD.unpack(header)
        offset += _RECORD.size
        if offset + length > size:
            return
        yield opcode, offset, length
        offset += length
        file.seek(offset)


def _bounded(file: BinaryIO, length: int, path: Path) -> bytes:
    if length > MAX_RECORD_BYTES:
        raise DataError(f"{path} has a record of {length} bytes, at most {MAX_RECORD_BYTES} are read")
    return file.read(length)


def _take_small(contents: Contents, opcode: int, data: bytes, path: Path) -> None:
    if opcode == _ATTACHMENT:
        attachment = _parsed("Attachment", data, path)
        contents.attachments[attachment.name] = attachment.data
    elif opcode == _METADATA:
        metadata = _parsed("Metadata", data, path)
        contents.metadata[metadata.name] = metadata.metadata
    else:
        contents.topics |= _topic(data, path)


def _topic(data: bytes, path: Path) -> dict[int, str]:
    channel = _parsed("Channel", data, path)
    return {channel.id: channel.topic}


def _chunk_content(data: bytes, path: Path) -> bytes:
    import zstandard

    chunk = _parsed("Chunk", data, path)
    content: bytes = chunk.data
    if chunk.compression == "zstd":
        try:
            size = zstandard.get_frame_parameters(content).content_size
            if not size <= MAX_RECORD_BYTES:  # unknown is huge
                raise DataError(f"{path} has a chunk that unpacks to more than {MAX_RECORD_BYTES} bytes")
            content = zstandard.ZstdDecompressor().decompress(content)
        except zstandard.ZstdError as error:
            raise DataError(f"{path} has a chunk that does not unpack: {error}") from error
    elif chunk.compression:
        raise DataError(
            f"{path} is compressed by {chunk.compression}: rewrite it with `mcap compress --compression zstd`"
        )
    if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
        raise DataError(
            f"{path} is damaged: the check sum of a chunk does not fit; `rig-server recover` leaves it out"
        )
    return content


def _parsed(kind: str, data: bytes, path: Path, *more: int) -> Any:
    """A record of the mcap library, out of its content; the stream holds no more than that."""
    from mcap import records
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError

    try:
        return getattr(records, kind).read(ReadDataStream(BytesIO(data)), *more)
    except (McapError, struct.error, ValueError, OverflowError) as error:
        raise DataError(f"{path} has a malformed {kind.lower()} record: {error!r}") from error
