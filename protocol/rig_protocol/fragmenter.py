"""A frame into sealed datagrams: all of them in a few NumPy operations."""

import numpy as np

from rig_protocol.datagram import (
    DEFAULT_DATAGRAM_SIZE,
    FRAGMENT_HEADER_SIZE,
    MAX_DATAGRAM_SIZE,
    DatagramBatch,
    FragmentHeader,
    write_fragment_headers,
)
from rig_protocol.errors import LinkUsageError
from rig_protocol.frame_unit import MAX_SEALED_SIZE, leading_seal, pack_unit, sealed_place
from rig_protocol.frames import EncodedFrame
from rig_protocol.security import TAG_SIZE, FrameSeal

_MAX_FRAGMENTS = 2**16


def fragment(
    frame: EncodedFrame,
    session_id: int,
    frame_number: int,
    seal: FrameSeal,
    datagram_size: int = DEFAULT_DATAGRAM_SIZE,
) -> DatagramBatch:
    """The datagrams of a frame, none longer than `datagram_size`; only the last may be shorter.

    `frame_number` counts the frames of the session: each is sealed once. LinkUsageError for a frame or a
    size that the protocol does not allow.
    """
    payload_size = datagram_size - FRAGMENT_HEADER_SIZE
    if (
        not payload_size > 0
        or datagram_size > MAX_DATAGRAM_SIZE
        or payload_size * _MAX_FRAGMENTS < MAX_SEALED_SIZE
    ):
        raise LinkUsageError(f"datagrams of {datagram_size} bytes cannot carry every frame")
    unit = pack_unit(frame)
    place = FragmentHeader(0, session_id, frame_number, len(unit) + TAG_SIZE, payload_size, 0)
    sealed = seal.seal(frame_number, unit, sealed_place(place))
    return _cut(sealed, place._replace(seal=leading_seal(sealed)))


def _cut(unit: bytes, first: FragmentHeader) -> DatagramBatch:
    size = FRAGMENT_HEADER_SIZE + first.payload_size
    count = first.fragment_count
    rows = np.empty((count, size), dtype=np.uint8)
    write_fragment_headers(first, rows)
    content = np.frombuffer(unit, dtype=np.uint8)
    whole = (count - 1) * first.payload_size
    rows[:-1, FRAGMENT_HEADER_SIZE:] = content[:whole].reshape(count - 1, first.payload_size)
    rest = len(unit) - whole
    rows[-1, FRAGMENT_HEADER_SIZE : FRAGMENT_HEADER_SIZE + rest] = content[whole:]
    total = count * FRAGMENT_HEADER_SIZE + len(unit)
    return DatagramBatch(rows.reshape(-1).data[:total], size)
