"""PLY files: what we write others read, and a hostile header is refused."""

from pathlib import Path

import numpy as np
import pytest

from rig_calib.fusion.cloud import PointCloud
from rig_calib.fusion.ply import read_ply, write_ply
from rig_protocol.errors import ConfigurationError, DataError

VERTEX = (
    "property float x\nproperty float y\nproperty float z\n"
    "property uchar red\nproperty uchar green\nproperty uchar blue\n"
)


def random_cloud(count: int) -> PointCloud:
    rng = np.random.default_rng(3)
    points = rng.normal(size=(count, 3)).astype(np.float32)
    return PointCloud(points, rng.integers(0, 256, (count, 3), dtype=np.uint8))


def hostile(path: Path, header: str, body: bytes = b"") -> Path:
    path.write_bytes(header.encode("latin-1") + body)
    return path


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_a_written_cloud_reads_back_bit_exactly(tmp_path: Path, count: int) -> None:
    cloud = random_cloud(count)
    write_ply(tmp_path / "cloud.ply", cloud)
    again = read_ply(tmp_path / "cloud.ply")
    assert np.array_equal(again.points_m, cloud.points_m)
    assert np.array_equal(again.colors, cloud.colors)


def test_file_layout_is_header_then_fifteen_bytes_a_point(tmp_path: Path) -> None:
    cloud = PointCloud(np.array([[1, 2, 3]], np.float32), np.array([[10, 20, 30]], np.uint8))
    write_ply(tmp_path / "cloud.ply", cloud)
    header, body = (tmp_path / "cloud.ply").read_bytes().split(b"end_header\n")
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\n")
    assert b"element vertex 1\n" + VERTEX.encode() in header
    assert body == np.array([1, 2, 3], "<f4").tobytes() + bytes([10, 20, 30])


def test_writing_leaves_no_half_file_behind(tmp_path: Path) -> None:
    write_ply(tmp_path / "cloud.ply", random_cloud(5))
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.ply"]


def test_further_properties_and_elements_are_passed_over(tmp_path: Path) -> None:
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment by another program\nelement vertex 1\n"
        + VERTEX
        + "property double quality\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
    )
    body = np.array([1, 2, 3], "<f4").tobytes() + bytes([4, 5, 6]) + np.float64(9).tobytes()
    cloud = read_ply(hostile(tmp_path / "other.ply", header, body))
    assert cloud.points_m.tolist() == [[1, 2, 3]]
    assert cloud.colors.tolist() == [[4, 5, 6]]


HEAD = "ply\nformat binary_little_endian 1.0\n"


@pytest.mark.parametrize(
    ("header", "complaint"),
    [
        ("", "ends in the middle"),
        ("obj\n", "not a PLY"),
        ("ply\nformat ascii 1.0\nend_header\n", "binary_little_endian"),
        (HEAD + "element vertex 99999999999\n" + VERTEX + "end_header\n", "announced"),
        (HEAD + "element vertex 9999999999999\n" + VERTEX + "end_header\n", "not understood"),
        (HEAD + "element vertex -1\n" + VERTEX + "end_header\n", "not understood"),
        (HEAD + "element vertex 1\n" + VERTEX + "property float x\nend_header\n", "distinct"),
        (HEAD + "element vertex 1\nproperty list uchar int i\n" + VERTEX + "end_header\n", "scalars"),
        (HEAD + "element vertex 1\nproperty float x\nend_header\n", "x y z"),
        (HEAD + "element face 1\nproperty float x\nend_header\n", "first element"),
        (HEAD + "property float x\nend_header\n", "not understood"),
        (HEAD + "comment no end\n" * 300, "no end_header"),
        (HEAD + "comment " + "a" * 5000 + "\n", "middle of a line"),
        (HEAD + "comment \xff\n", "ASCII"),
        (HEAD + "end_header\n", "first element"),
    ],
)
def test_a_hostile_header_is_refused_with_the_reason(tmp_path: Path, header: str, complaint: str) -> None:
    with pytest.raises(DataError, match=complaint):
        read_ply(hostile(tmp_path / "bad.ply", header, b"\0" * 15))


def test_a_file_cut_short_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    write_ply(path, random_cloud(100))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(DataError, match="announced"):
        read_ply(path)


def test_a_file_that_does_not_exist_is_the_users_mistake(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="cannot be read"):
        read_ply(tmp_path / "none.ply")


def test_points_and_colors_must_have_the_same_length() -> None:
    with pytest.raises(ValueError, match="both be"):
        PointCloud(np.zeros((2, 3), np.float32), np.zeros((3, 3), np.uint8))
