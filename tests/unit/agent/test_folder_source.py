"""Rules of the folder source: loops in real time, one kind of image, mistakes are named."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rig_agent.sources.folder import FolderSource
from rig_protocol.camera import CameraModel
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import RgbdFrame
from rig_protocol.gravity import Gravity
from rig_protocol.rig_folder import CameraEntry, RigDescription, write_rig_folder
from support.real_data import real_data
from support.virtual_time import VirtualTime

INTERVAL_NS = 100_000_000
FELT = Gravity((0.6, 0.8, 0.0))


def make_frame(index: int) -> RgbdFrame:
    image = np.full((48, 64), index, np.uint8)
    return RgbdFrame(7, index, 0, color=np.dstack([image] * 3), raw=image.astype(np.uint16), gravity=FELT)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    entry = CameraEntry(7, "left", CameraModel(source="file"))
    write_rig_folder(tmp_path, RigDescription((entry,)), [make_frame(index) for index in range(3)])
    return tmp_path


def open_folder(folder: Path, time: VirtualTime, camera: int | str = 7) -> FolderSource:
    return FolderSource(folder, camera, 1e9 / INTERVAL_NS, clock=time, sleep=time.sleep)


def shown(source: FolderSource) -> int:
    frame = source.read(1.0)
    assert frame is not None
    assert frame.color is not None
    return int(frame.color[0, 0, 0])


def test_frames_loop_in_order(folder: Path) -> None:
    source = open_folder(folder, VirtualTime())
    assert [shown(source) for _ in range(7)] == [1, 2, 0, 1, 2, 0, 1]


def test_frames_carry_what_the_camera_felt_when_they_were_recorded(folder: Path) -> None:
    frame = open_folder(folder, VirtualTime()).read(1.0)
    assert frame is not None
    assert frame.gravity is not None
    assert frame.gravity.down == pytest.approx(FELT.down)


def test_frames_come_at_the_rate_stamped_when_due(folder: Path) -> None:
    time = VirtualTime(5)
    source = open_folder(folder, time)
    for count in range(1, 5):
        frame = source.read(1.0)
        assert frame is not None
        assert frame.timestamp_ns == count * INTERVAL_NS == time.now_ns


def test_two_agents_of_one_machine_show_the_same_instant(folder: Path) -> None:
    time = VirtualTime()
    early = open_folder(folder, time)
    time.now_ns = 40 * INTERVAL_NS + 1
    late = open_folder(folder, time)
    frame = early.read(1.0)
    time.now_ns = 40 * INTERVAL_NS + 1
    other = late.read(1.0)
    assert frame is not None
    assert other is not None
    assert other.sequence - frame.sequence == 1  # the early one is owed the frame that was just due
    assert other.timestamp_ns - frame.timestamp_ns == INTERVAL_NS


def test_frames_due_while_nobody_read_are_skipped_and_counted(folder: Path) -> None:
    time = VirtualTime()
    source = open_folder(folder, time)
    time.now_ns = 5 * INTERVAL_NS
    frame = source.read(1.0)
    assert frame is not None
    assert frame.timestamp_ns == time.now_ns
    assert source.counters == {"skipped": 4}


def test_a_read_gives_up_after_its_time_out(folder: Path) -> None:
    time = VirtualTime()
    source = open_folder(folder, time)
    assert source.read(0.03) is None
    assert time.now_ns == 30_000_000
    assert source.read(0.08) is not None


def test_a_camera_is_found_by_name_and_described_as_the_folder_says(folder: Path) -> None:
    description = open_folder(folder, VirtualTime(), "left").describe()
    assert (description.camera_id, description.fps, description.model.source) == (7, 10.0, "file")
    assert (description.color_image, description.depth_image) == ("bgr", "raw")


def test_an_unknown_camera_is_refused_with_those_that_exist(folder: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"no camera right; it has 7 \(left\)"):
        open_folder(folder, VirtualTime(), "right")


def test_a_camera_without_frames_is_refused(folder: Path) -> None:
    for file in (folder / "left").glob("color_*"):
        file.unlink()
    with pytest.raises(ConfigurationError, match=r"left holds no color_"):
        open_folder(folder, VirtualTime())


def test_a_torn_first_image_is_refused_at_once(folder: Path) -> None:
    tear(folder / "left" / "color_000.png")
    with pytest.raises(DataError, match=r"color_000.png is not a readable image"):
        open_folder(folder, VirtualTime())


def test_a_torn_later_image_is_named_when_its_turn_comes(folder: Path) -> None:
    tear(folder / "left" / "raw_002.png")
    source = open_folder(folder, VirtualTime())
    source.read(1.0)
    with pytest.raises(DataError, match=r"raw_002.png is not a readable image"):
        source.read(1.0)


def test_a_frame_of_another_kind_is_refused(folder: Path) -> None:
    cv2.imwrite(str(folder / "left" / "color_001.png"), np.zeros((48, 64), np.uint8))
    with pytest.raises(DataError, match=r"frame 1 holds \('grey', 'raw'\)"):
        open_folder(folder, VirtualTime()).read(1.0)


def test_an_image_is_decoded_once(folder: Path) -> None:
    source = open_folder(folder, VirtualTime())
    first_pass = [shown(source) for _ in range(3)]
    for file in (folder / "left").iterdir():
        file.unlink()
    assert [shown(source) for _ in range(3)] == first_pass


def test_registered_depth_of_a_real_folder_is_marked_as_such() -> None:
    time = VirtualTime()
    frame = open_folder(real_data("tum_fr1_rpy_12views"), time, 11).read(1.0)
    assert frame is not None
    assert (frame.camera_id, frame.depth_frame) == (11, "color")
    assert frame.depth_mm is not None


def tear(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:60])
