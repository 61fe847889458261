"""Rules of what a program writes into rig.toml: only what was asked for, and never an invalid file."""

from pathlib import Path

import pytest

from rig_protocol.errors import ConfigurationError
from rig_protocol.settings_docs import write_commented_toml
from rig_server.config import RigSettings, load_rig_settings
from rig_server.rig_toml import assign_slot

WRITTEN = """\
# the ring in the atrium
expected_cameras = 2  # for now

[[cameras]]
id = 0       # next to the door
serial = "A0"

[[cameras]]
id = 1
port_path = "1-1.2"
name = "window"

[link]
speed_mbit = 1000 # the old switch
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text(WRITTEN)
    return path


def slots(file: Path) -> dict[int, tuple[str | None, str | None, str | None]]:
    cameras = load_rig_settings(file).cameras
    return {camera.id: (camera.serial, camera.port_path, camera.name) for camera in cameras}


def test_a_slot_gets_another_camera_and_nothing_else_changes(file: Path) -> None:
    assert assign_slot(file, 0, "B7") == []
    assert file.read_text() == WRITTEN.replace('"A0"', '"B7"')


def test_a_new_slot_is_added_and_counted(file: Path) -> None:
    assert assign_slot(file, 5, "B7", name="stage") == ["slot 5 is new"]
    assert slots(file) == {0: ("A0", None, None), 1: (None, "1-1.2", "window"), 5: ("B7", None, "stage")}
    text = file.read_text()
    assert load_rig_settings(file).expected_cameras == 3
    for comment in ("# the ring in the atrium", "# for now", "# next to the door", "# the old switch"):
        assert comment in text


def test_a_camera_that_moves_leaves_its_old_slot(file: Path) -> None:
    assert assign_slot(file, 1, "A0") == ["slot 0 has no camera now"]
    assert slots(file) == {0: (None, None, None), 1: ("A0", None, "window")}


def test_a_camera_without_a_serial_number_is_known_by_its_port(file: Path) -> None:
    assign_slot(file, 0, None, "1-1.4")
    assert slots(file)[0] == (None, "1-1.4", None)


def test_the_first_slot_of_the_file_that_init_writes(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    write_commented_toml(RigSettings, file, force=False)
    before = file.read_text()
    told = assign_slot(file, 3, "B7")
    assert "takes only the cameras listed there" in told[0]
    assert slots(file) == {3: ("B7", None, None)}
    assert file.read_text().startswith(before.rstrip("\n"))


def test_cameras_that_are_written_in_one_line_stay_so(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text('cameras = [{id = 0, serial = "A0"}] # few\n')
    assign_slot(file, 1, "B7")
    assert slots(file) == {0: ("A0", None, None), 1: ("B7", None, None)}
    assert "# few" in file.read_text()


def test_owner_only_files_stay_so(file: Path) -> None:
    file.chmod(0o640)
    assign_slot(file, 0, "B7")
    assert file.stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("name", ["window", "a name with blanks"])
def test_a_file_that_would_be_wrong_is_left_as_it_was(file: Path, name: str) -> None:
    with pytest.raises(ConfigurationError, match="is left as it was"):
        assign_slot(file, 0, "B7", name=name)
    assert file.read_text() == WRITTEN
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize("text", ["[[cameras]", "\x00", 'cameras = "none"', "cameras = [1]"])
def test_a_file_that_is_no_rig_toml_is_refused(file: Path, text: str) -> None:
    file.write_text(text)
    with pytest.raises(ConfigurationError, match=r"rig\.toml"):
        assign_slot(file, 0, "B7")
    assert file.read_text() == text
