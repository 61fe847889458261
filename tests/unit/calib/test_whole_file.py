"""Rules of files that are written whole or not at all."""

from pathlib import Path

import pytest

from rig_calib.whole_file import whole_file
from rig_protocol.errors import RigError


def test_the_file_appears_when_the_block_ends(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    path.write_bytes(b"older")
    with whole_file(path) as file:
        file.write(b"newer")
        assert path.read_bytes() == b"older"
    assert path.read_bytes() == b"newer"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_told_and_leaves_the_older_file(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    path.write_bytes(b"older")
    with (
        pytest.raises(RigError, match=r"cloud\.ply could not be written: No space left on device"),
        whole_file(path),
    ):
        raise OSError(28, "No space left on device")
    assert path.read_bytes() == b"older"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    with (
        pytest.raises(RigError, match="No such file or directory"),
        whole_file(tmp_path / "no" / "cloud.ply"),
    ):
        pass
