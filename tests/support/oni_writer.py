"""Writes .oni recordings: uncompressed depth and colour, in the layout that OpenNI2's own recorder writes.

A file is a header and a list of records. A record is a header of 28 bytes, its fields and its payload:
"NIR\\0", type, node, bytes of header and fields, bytes of payload, position of the record that it undoes.
Node 1, 2, ... is a stream; its `added` record is written again at the end, when all its numbers are known.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np
import numpy.typing as npt

HORIZONTAL_FOV, VERTICAL_FOV = 1.0144686707507438, 0.78980943449644714  # radians, of a PrimeSense camera

_INT, _GENERAL, _REMOVED, _BEGIN, _READY, _DATA, _END, _ADDED, _SEEK = 3, 6, 7, 8, 9, 10, 11, 13, 14
_UNKNOWN_U32, _UNKNOWN_U64 = 2**32 - 1, 2**64 - 1


@dataclass(frozen=True)
class PixelFormat:
    """How the two generations of OpenNI number a format."""

    node_type: int  # 2 depth, 3 image
    oni: int
    xn: int
    bytes_per_pixel: int


DEPTH_1_MM = PixelFormat(2, 100, 4, 2)
DEPTH_100_UM = PixelFormat(2, 101, 4, 2)
RGB888 = PixelFormat(3, 200, 1, 3)


@dataclass
class _Node:
    pixels: PixelFormat
    added: int = 0  # position of its first record
    last: int = 0  # ... of its last image
    images: int = 0
    timestamp: int = 0
    seek_table: list[tuple[int, int, int]] = field(default_factory=lambda: [(0, 0, 0)])


class OniWriter:
    """A recording; `close` makes the file whole."""

    def __init__(
        self,
        path: Path,
        streams: Sequence[PixelFormat],
        fps: int = 30,
        *,
        shape: tuple[int, int] = (480, 640),
        mirrored: bool = False,
    ) -> None:
        """Write the header and what describes the streams."""
        self._file: BinaryIO = path.open("wb")
        self._nodes = {number: _Node(pixels) for number, pixels in enumerate(streams, 1)}
        self._file.write(b"NI10" + struct.pack("<BBHIQI", 1, 0, 1, 0, _UNKNOWN_U64, len(streams)))
        for number, node in self._nodes.items():
            self._describe(number, node, (*shape, fps), mirrored)
        for number in self._nodes:
            self._record(_READY, number)
            self._record(_BEGIN, number, struct.pack("<IQ", _UNKNOWN_U32, _UNKNOWN_U64))

    def write(self, number: int, timestamp: int, image: npt.NDArray[np.generic]) -> None:
        """Add an image to stream 1, 2, ...; depth as u16, colour as RGB."""
        node = self._nodes[number]
        node.images += 1
        node.timestamp = timestamp
        node.last = self._record(
            _DATA, number, struct.pack("<QI", timestamp, node.images), image.tobytes(), node.last
        )
        node.seek_table.append((timestamp, 0, node.last))

    def close(self) -> None:
        """Write the tables and the end."""
        for number, node in self._nodes.items():
            self._record(_REMOVED, number, undoes=node.added)
            entries = b"".join(struct.pack("<QIQ", *entry) for entry in node.seek_table)
            seek_table = self._record(_SEEK, number, payload=entries)
            end = self._file.tell()
            self._file.seek(node.added)
            self._add(number, node, seek_table)
            self._file.seek(end)
        self._record(_END, 0)
        self._file.close()

    def __enter__(self) -> Self:
        """The writer itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        """Close."""
        self.close()

    def _describe(self, number: int, node: _Node, mode: tuple[int, int, int], mirrored: bool) -> None:
        height, width, fps = mode
        node.added = self._file.tell()
        self._add(number, node, seek_table=0)
        output = struct.pack("<III", width, height, fps)
        self._integer(number, "oniRequiredFrameSize", width * height * node.pixels.bytes_per_pixel)
        self._integer(number, "xnIsGenerating", 1)
        if node.pixels.node_type == DEPTH_1_MM.node_type:
            self._integer(number, "xnDeviceMaxDepth", 10_000)
        self._integer(number, "xnSupportedMapOutputModesCount", 1)
        self._general(number, "xnSupportedMapOutputModes", output)
        self._general(number, "xnMapOutputMode", output)
        self._general(number, "xnSupportedPixelFormats", struct.pack("<I", 1 << (node.pixels.xn - 1)))
        self._integer(number, "xnPixelFormat", node.pixels.xn)
        self._integer(number, "oniPixelFormat", node.pixels.oni)
        self._integer(number, "xnMirror", int(mirrored))
        # The player drops every image of a stream that tells no cropping.
        self._integer(number, "Cropping", 1)
        self._general(number, "xnCropping", struct.pack("<iHHHH", 0, 0, 0, width, height))
        self._general(number, "xnFOV", struct.pack("<dd", HORIZONTAL_FOV, VERTICAL_FOV))

    def _add(self, number: int, node: _Node, seek_table: int) -> None:
        name = _text("Depth" if node.pixels.node_type == DEPTH_1_MM.node_type else "Image")
        numbers = struct.pack(
            "<I4sIQQQ", node.pixels.node_type, b"NONE", node.images, 0, node.timestamp, seek_table
        )
        self._record(_ADDED, number, name + numbers)

    def _integer(self, number: int, name: str, value: int) -> None:
        self._record(_INT, number, _text(name) + struct.pack("<IQ", 8, value))

    def _general(self, number: int, name: str, value: bytes) -> None:
        self._record(_GENERAL, number, _text(name) + struct.pack("<I", len(value)) + value)

    def _record(
        self, kind: int, number: int, fields: bytes = b"", payload: bytes = b"", undoes: int = 0
    ) -> int:
        position = self._file.tell()
        header = struct.pack("<4sIIIIQ", b"NIR\0", kind, number, 28 + len(fields), len(payload), undoes)
        self._file.write(header + fields + payload)
        return position


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text) + 1) + text.encode() + b"\0"
