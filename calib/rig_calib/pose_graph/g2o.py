"""Pose graphs in g2o's text format (Kümmerle et al., "g2o", ICRA 2011): VERTEX_SE3:QUAT, EDGE_SE3:QUAT, FIX.

    VERTEX_SE3:QUAT id  x y z  qx qy qz qw
    EDGE_SE3:QUAT i j  x y z  qx qy qz qw  21 numbers: the upper triangle of the 6×6 information, by rows
    FIX id

A pose line is T_world_id, an edge's T_i_j. The file's information is translation first, ours rotation first:
the two 3×3 blocks change places and the cross block is transposed. Its rotation part is taken as that of a
rotation vector in rad, as GTSAM and SE-Sync do; g2o's own error, the quaternion's vector part, is half of it.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rig_calib.pose_graph.edge_batch import EdgeBatch
from rig_calib.rotations import quaternions, rotations_of
from rig_calib.whole_file import whole_file
from rig_protocol.errors import ConfigurationError, DataError

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_VERTEX, _EDGE, _FIX = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", "FIX"
_PARAMETERS = "PARAMS_"  # of sensors, which these edges do not use
_UPPER = np.triu_indices(6)
_SWAPPED = np.array([3, 4, 5, 0, 1, 2])
_QUATERNION_NORM_TOLERANCE = 0.01  # files hold six digits
_LARGEST = 1e12  # of any number: a metre, an information
_LARGEST_ID = 2**62
_INDEPENDENT = 1e-9  # least eigenvalue of an information that is scaled to a unit diagonal


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraph:
    """N poses T (N,4,4) with their ids, the edges between them by row, and which poses (N,) are fixed."""

    ids: tuple[int, ...]
    T: Array
    edges: EdgeBatch
    fixed: Mask

    def with_poses(self, T: Array) -> "PoseGraph":
        """The same graph, its poses elsewhere."""
        return replace(self, T=T)


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """What stands in the lines of a file, with the number of each line."""

    vertices: dict[int, list[float]]
    edges: list[tuple[int, int, list[float]]]
    fixed: list[tuple[int, int]]
    edge_line: list[int]
    vertex_line: list[int]


def read_g2o(path: Path) -> PoseGraph:
    """Read a pose graph. ConfigurationError when absent; DataError names the line that does not fit."""
    try:
        with path.open(encoding="utf-8") as file:
            return parse_g2o(file)
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path} is no text, so no .g2o file: {error.reason}") from error
    except DataError as error:
        raise DataError(f"{path}, {error}") from error


def parse_g2o(lines: Iterable[str]) -> PoseGraph:
    """The pose graph of a file's lines; vertices keep their order. DataError names the line."""
    found = _sorted_lines(lines)
    row = {node: k for k, node in enumerate(found.vertices)}
    for (i, j, _), line in zip(found.edges, found.edge_line, strict=True):
        for node in (i, j):
            if node not in row:
                raise DataError(
                    f"line {line}: the edge {i} {j} names vertex {node}, which the file does not hold"
                )
        if i == j:
            raise DataError(f"line {line}: the edge joins vertex {i} to itself")
    fixed = np.zeros(len(row), dtype=bool)
    for node, line in found.fixed:
        if node not in row:
            raise DataError(f"line {line}: FIX names vertex {node}, which the file does not hold")
        fixed[row[node]] = True
    poses = _poses(np.array(list(found.vertices.values())).reshape(-1, 7), found.vertex_line)
    numbers = np.array([values for _, _, values in found.edges]).reshape(-1, 28)
    edges = EdgeBatch(
        np.array([row[i] for i, _, _ in found.edges], dtype=np.intp),
        np.array([row[j] for _, j, _ in found.edges], dtype=np.intp),
        _poses(numbers[:, :7], found.edge_line),
        _information(numbers[:, 7:], found.edge_line),
    )
    return PoseGraph(tuple(row), poses, edges, fixed)


def write_g2o(path: Path, graph: PoseGraph) -> None:
    """Write a pose graph, the file whole or not at all; numbers keep all their digits."""
    with whole_file(path) as file:
        file.write("".join(f"{line}\n" for line in format_g2o(graph)).encode())


def format_g2o(graph: PoseGraph) -> Iterator[str]:
    """The lines of a file: vertices, fixed ones, edges."""
    for node, numbers in zip(graph.ids, _pose_numbers(graph.T), strict=True):
        yield f"{_VERTEX} {node} {_text(numbers)}"
    for row in np.flatnonzero(graph.fixed):
        yield f"{_FIX} {graph.ids[row]}"
    edges = graph.edges
    information = edges.information[:, _SWAPPED][:, :, _SWAPPED][:, _UPPER[0], _UPPER[1]]
    numbers = np.concatenate([_pose_numbers(edges.T_i_j), information], axis=1)
    for i, j, line in zip(edges.i, edges.j, numbers, strict=True):
        yield f"{_EDGE} {graph.ids[i]} {graph.ids[j]} {_text(line)}"


def _sorted_lines(lines: Iterable[str]) -> _Lines:
    found = _Lines({}, [], [], [], [])
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith(("#", _PARAMETERS)):
            continue
        try:
            _sort(found, words, number)
        except ValueError as error:
            raise DataError(f"line {number}: {error}") from error
    if not found.vertices or not found.edges:
        missing = _EDGE if found.vertices else _VERTEX
        raise DataError(f"no line {missing}: this is not a pose graph of 3D poses")
    return found


def _sort(found: _Lines, words: list[str], line: int) -> None:
    """Put one line where it belongs; ValueError says what is wrong with it."""
    tag = words[0]
    if tag == _VERTEX:
        (node,), values = _ids_and_numbers(words, ids=1, numbers=7)
        if node in found.vertices:
            raise ValueError(f"vertex {node} stands in the file twice")
        found.vertices[node] = values
        found.vertex_line.append(line)
    elif tag == _EDGE:
        (i, j), values = _ids_and_numbers(words, ids=2, numbers=28)
        found.edges.append((i, j, values))
        found.edge_line.append(line)
    elif tag == _FIX:
        found.fixed.extend((node, line) for node in _ids(words[1:]))
    else:
        raise ValueError(
            f"{tag[:40]!r} is none of {_VERTEX}, {_EDGE}, {_FIX}: only graphs of 3D poses are read"
        )


def _ids_and_numbers(words: list[str], ids: int, numbers: int) -> tuple[list[int], list[float]]:
    if len(words) != 1 + ids + numbers:
        raise ValueError(f"{words[0]} has {len(words) - 1} values, not {ids + numbers}")
    values = [float(word) for word in words[1 + ids :]]
    if not all(abs(value) <= _LARGEST for value in values):  # nor are NaN
        raise ValueError(f"{words[0]} holds a number that is not finite, or beyond {_LARGEST:g}")
    return _ids(words[1 : 1 + ids]), values


def _ids(words: list[str]) -> list[int]:
    ids = [int(word) for word in words]
    if any(abs(node) > _LARGEST_ID for node in ids):
        raise ValueError("a vertex id has more than 62 bits")
    return ids


def _poses(numbers: Array, lines: list[int]) -> Array:
    """T (N,4,4) of x y z qx qy qz qw (N,7)."""
    norm = np.linalg.norm(numbers[:, 3:], axis=1)
    for wrong in np.flatnonzero(np.abs(norm - 1.0) > _QUATERNION_NORM_TOLERANCE):
        raise DataError(f"line {lines[wrong]}: the quaternion's norm is {norm[wrong]:.3g}, not 1")
    T = np.tile(np.eye(4), (len(numbers), 1, 1))
    T[:, :3, :3] = rotations_of(numbers[:, [6, 3, 4, 5]] / norm[:, None])
    T[:, :3, 3] = numbers[:, :3]
    return T


def _information(numbers: Array, lines: list[int]) -> Array:
    """Information (M,6,6), rotation first, of the upper triangles (M,21) of translation-first ones."""
    full = np.zeros((len(numbers), 6, 6))
    full[:, _UPPER[0], _UPPER[1]] = full[:, _UPPER[1], _UPPER[0]] = numbers
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", full), 0.0))
    correlation = full / np.maximum(scale[:, :, None] * scale[:, None, :], np.finfo(float).tiny)
    for wrong in np.flatnonzero(np.linalg.eigvalsh(correlation)[:, 0] < _INDEPENDENT):
        raise DataError(f"line {lines[wrong]}: the information matrix is not positive definite")
    return full[:, _SWAPPED][:, :, _SWAPPED]


def _pose_numbers(T: Array) -> Array:
    """x y z qx qy qz qw (N,7) of T (N,4,4)."""
    return np.concatenate([T[:, :3, 3], quaternions(T[:, :3, :3])[:, [1, 2, 3, 0]]], axis=1)


def _text(numbers: Array) -> str:
    return " ".join(map(repr, numbers.tolist()))
