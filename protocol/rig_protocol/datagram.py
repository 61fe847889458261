"""Bytes of every datagram: the common prefix, the fragment header, and batches of datagrams.

Byte tables: protocol/SPEC.md, sections 2 and 3. All numbers are little-endian.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rig_protocol.errors import LinkUsageError

Buffer = bytes | bytearray | memoryview

MAGIC = b"KR"
VERSION = 2
SERVICE_TYPE = "_kinect-rig._udp.local."
"""Under which servers announce themselves by mDNS."""

# 1500 (Ethernet) - 20 (IPv4) - 8 (UDP).
DEFAULT_DATAGRAM_SIZE = 1472
# A control message is never split, and the longest hello needs this much. Every IPv6 path carries 1232.
MIN_DATAGRAM_SIZE = 1200
# What IPv4 and UDP can carry; jumbo frames use 8972.
MAX_DATAGRAM_SIZE = 65507

_PREFIX = struct.Struct("<2sBBIQ")
PREFIX_SIZE = _PREFIX.size
_FRAGMENT = struct.Struct("<2sBBIQQIHH")
FRAGMENT_HEADER_SIZE = _FRAGMENT.size

FRAGMENT_HEADER = np.dtype(
    [
        ("magic", "S2"),
        ("version", "u1"),
        ("type", "u1"),
        ("seal", "<u4"),
        ("session_id", "<u8"),
        ("frame_number", "<u8"),
        ("unit_size", "<u4"),
        ("payload_size", "<u2"),
        ("fragment_index", "<u2"),
    ]
)

# Seen as four 64-bit words, the header of the next fragment is this one's plus one in the index,
# which fills the top 16 bits of the last word.
_WORDS = FRAGMENT_HEADER_SIZE // 8
_NEXT_FRAGMENT = np.array([0, 0, 0, 1 << 48], dtype="<u8")
# NumPy's fixed cost pays from about so many headers on.
_WORTH_COMPARING = 16
_INDEX_AT = FRAGMENT_HEADER_SIZE - 2


class MessageType(IntEnum):
    """Fourth byte of every datagram."""

    HELLO = 1
    WELCOME = 2
    REJECT = 3
    GOODBYE = 4
    HEARTBEAT = 5
    CLOCK_REQUEST = 6
    CLOCK_REPLY = 7
    UNKNOWN_SESSION = 8
    RESEND = 9
    PLAN = 10
    CONTROL = 11
    CONTROL_RESULT = 12
    FRAGMENT = 16


FRAGMENT_PREFIX = MAGIC + bytes((VERSION, MessageType.FRAGMENT))


class Prefix(NamedTuple):
    """The first 16 bytes of every datagram; `id` is a session id, or a hello's nonce."""

    magic: bytes
    version: int
    type: int
    crc: int
    id: int


class FragmentHeader(NamedTuple):
    """What a fragment says of itself; `payload_size` is that of every fragment but the last.

    `seal` is the start of the unit's authentication tag: it tells units apart before one is whole.
    """

    seal: int
    session_id: int
    frame_number: int
    unit_size: int
    payload_size: int
    fragment_index: int

    @property
    def fragment_count(self) -> int:
        """Fragments that the whole unit takes."""
        return -(-self.unit_size // self.payload_size)


@dataclass(frozen=True, slots=True)
class DatagramBatch:
    """Datagrams back to back: all `segment_size` bytes long, the last possibly shorter.

    This is what UDP_GRO delivers and UDP_SEGMENT sends; a plain datagram is a batch of one.
    """

    buffer: Buffer
    segment_size: int

    def __post_init__(self) -> None:
        if self.segment_size <= 0:
            raise LinkUsageError(f"segment size {self.segment_size} of a datagram batch must be positive")

    def __len__(self) -> int:
        return -(-len(self.buffer) // self.segment_size)

    def __getitem__(self, index: int) -> memoryview:
        if not 0 <= index < len(self):
            raise IndexError(index)
        return self.part(index, index + 1)

    def __iter__(self) -> Iterator[memoryview]:
        return (self[index] for index in range(len(self)))

    @property
    def total_bytes(self) -> int:
        """Bytes of all datagrams together."""
        return len(self.buffer)

    def part(self, start: int, stop: int) -> memoryview:
        """The bytes of datagrams [start, stop), not copied; for a sender that takes so many at a time."""
        return memoryview(self.buffer)[start * self.segment_size : stop * self.segment_size]


def parse_prefix(datagram: Buffer) -> Prefix | None:
    """The common prefix, or None when there are fewer than 16 bytes. Nothing else is checked."""
    return Prefix._make(_PREFIX.unpack_from(datagram)) if len(datagram) >= PREFIX_SIZE else None


def pack_prefix(message_type: MessageType, crc: int, id_: int) -> bytes:
    """The common prefix of a datagram of our version."""
    return _PREFIX.pack(MAGIC, VERSION, message_type, crc, id_)


def parse_fragment_header(datagram: Buffer) -> FragmentHeader | None:
    """The header of a datagram whose prefix says FRAGMENT; None when it is too short or divides by zero."""
    if len(datagram) <= FRAGMENT_HEADER_SIZE:
        return None
    header = FragmentHeader._make(_FRAGMENT.unpack_from(datagram)[3:])
    return header if header.payload_size and header.unit_size else None


def pack_fragment_header(header: FragmentHeader) -> bytes:
    """The 32 bytes of one fragment header."""
    return _FRAGMENT.pack(MAGIC, VERSION, MessageType.FRAGMENT, *header)


def write_fragment_headers(first: FragmentHeader, rows: npt.NDArray[np.uint8]) -> None:
    """Write the headers of `first` and the fragments that follow it into rows (n, datagram bytes)."""
    headers = np.ndarray((len(rows),), FRAGMENT_HEADER, rows.data, strides=(rows.strides[0],))
    headers[:] = np.frombuffer(pack_fragment_header(first), FRAGMENT_HEADER)
    headers["fragment_index"] += np.arange(len(rows), dtype=np.uint16)


def consecutive_runs(batch: DatagramBatch) -> Iterator[tuple[int, memoryview]]:
    """The batch cut into runs (count, bytes) of equal-sized datagrams whose headers continue the first one's.

    Anything that is no fragment, and the shorter last datagram, is a run of its own.
    """
    full = len(batch.buffer) // batch.segment_size
    if batch.segment_size <= FRAGMENT_HEADER_SIZE:
        edges = list(range(full + 1))
    elif full >= _WORTH_COMPARING:
        edges = _edges_of_many(batch, full)
    else:
        edges = _edges_of_few(memoryview(batch.buffer), batch.segment_size, full)
    yield from ((stop - start, batch.part(start, stop)) for start, stop in pairwise(edges))
    if full < len(batch):
        yield 1, batch.part(full, full + 1)


def _edges_of_many(batch: DatagramBatch, full: int) -> list[int]:
    """Where runs begin, and `full`: by one comparison of all headers."""
    words = np.ndarray((full, _WORDS), "<u8", batch.buffer, strides=(batch.segment_size, 8))
    follows = (words[1:] - words[:-1] == _NEXT_FRAGMENT).all(axis=1)
    return [0, *(np.flatnonzero(~follows) + 1).tolist(), full]


def _edges_of_few(buffer: memoryview, size: int, full: int) -> list[int]:
    """The same, header by header: what all of a frame share, and the index, which counts up."""
    edges, shared, index = [0], b"", 0
    for k in range(full):
        start, index = k * size, index + 1
        end = start + _INDEX_AT
        here = buffer[end] | buffer[end + 1] << 8
        if here != index or buffer[start:end].tobytes() != shared:
            shared, index = buffer[start:end].tobytes(), here
            if k:
                edges.append(k)
    return [*edges, full] if full else [0]
