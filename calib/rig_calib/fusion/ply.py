"""PLY files of coloured points: binary, little-endian, as MeshLab, CloudCompare and Open3D open them.

Format: Greg Turk, The PLY Polygon File Format, 1994.
"""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from rig_calib.fusion.cloud import PointCloud
from rig_calib.whole_file import whole_file
from rig_protocol.errors import ConfigurationError, DataError

_WRITTEN = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
)
_PROPERTY = {"<f4": "float", "|u1": "uchar"}
_SCALARS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}
_MAX_LINE_BYTES = 1024
_MAX_HEADER_LINES = 256  # a header names its properties, one a line; ours has ten lines
_CHUNK_POINTS = 1 << 20  # rows that are interleaved at once: 15 MB beside the cloud itself


def write_ply(path: Path, cloud: PointCloud) -> None:
    """Write the cloud, the file whole or not at all; vertices hold x y z float, red green blue uchar."""
    with whole_file(path) as file:
        file.write(_header(len(cloud)))
        for start in range(0, len(cloud), _CHUNK_POINTS):
            rows = slice(start, start + _CHUNK_POINTS)
            file.write(_interleave(cloud, rows).tobytes())


def read_ply(path: Path) -> PointCloud:
    """Read a binary little-endian PLY of coloured points; further vertex properties are passed over.

    ConfigurationError when there is no such file, DataError when it is none of these or is cut short.
    """
    try:
        with path.open("rb") as file:
            count, dtype = _read_header(file)
            available = path.stat().st_size - file.tell()
            if count * dtype.itemsize > available:
                raise DataError(f"{count} points announced, room for {available // dtype.itemsize}")
            vertices = np.frombuffer(file.read(count * dtype.itemsize), dtype)
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read: {error.strerror}") from error
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
    points = np.stack([vertices[name] for name in ("x", "y", "z")], axis=1).astype(np.float32)
    colors = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=1)
    return PointCloud(points, colors)


def _header(count: int) -> bytes:
    properties = [f"property {_PROPERTY[_WRITTEN[name].str]} {name}" for name in _WRITTEN.names or ()]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment points in metres, rig frame",
        f"element vertex {count}",
        *properties,
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def _interleave(cloud: PointCloud, rows: slice) -> np.ndarray:
    points, colors = cloud.points_m[rows], cloud.colors[rows]
    vertices = np.empty(len(points), _WRITTEN)
    for axis, name in enumerate(("x", "y", "z")):
        vertices[name] = points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colors[:, channel]
    return vertices


def _read_header(file: BinaryIO) -> tuple[int, np.dtype]:
    """Number of vertices and their layout; the file then stands at the first one."""
    if _line(file) != ["ply"]:
        raise DataError("not a PLY file")
    if _line(file)[:2] != ["format", "binary_little_endian"]:
        raise DataError("only binary_little_endian PLY is read; convert the file")
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    for _ in range(_MAX_HEADER_LINES):
        words = _line(file)
        if words == ["end_header"]:
            return _vertex_layout(elements)
        _take_header_line(words, elements)
    raise DataError(f"no end_header within {_MAX_HEADER_LINES} lines")


def _line(file: BinaryIO) -> list[str]:
    line = file.readline(_MAX_LINE_BYTES)
    if not line.endswith(b"\n"):
        raise DataError("the header ends in the middle of a line")
    try:
        return line.decode("ascii").split()
    except UnicodeDecodeError as error:
        raise DataError("the header is not ASCII") from error


def _take_header_line(words: list[str], elements: list[tuple[str, int, list[tuple[str, str]]]]) -> None:
    match words:
        case ["comment" | "obj_info", *_] | []:
            return
        case ["element", name, count] if count.isdigit() and len(count) <= 12:
            elements.append((name, int(count), []))
        case ["property", kind, name] if kind in _SCALARS and elements:
            elements[-1][2].append((name, _SCALARS[kind]))
        case ["property", "list", _, _, name] if elements:
            elements[-1][2].append((name, "list"))
        case _:
            raise DataError(f"header line not understood: {' '.join(words)!r}")


def _vertex_layout(elements: list[tuple[str, int, list[tuple[str, str]]]]) -> tuple[int, np.dtype]:
    if not elements or elements[0][0] != "vertex":
        raise DataError("the first element must be `vertex`")
    _, count, properties = elements[0]
    kinds = dict(properties)
    if len(kinds) != len(properties) or "list" in kinds.values():
        raise DataError("vertex properties must be scalars with distinct names")
    colored = all(kinds.get(name) == "u1" for name in ("red", "green", "blue"))
    placed = all(kinds.get(name) in ("<f4", "<f8") for name in ("x", "y", "z"))
    if not (colored and placed):
        raise DataError("vertices need x y z as float and red green blue as uchar")
    return count, np.dtype(properties)
