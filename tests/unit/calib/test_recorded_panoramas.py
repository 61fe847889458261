"""Offline programs take a recording where they take a rig folder: the whole sets, in their order."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rig_calib.rig_folder_calibration import read_description, read_panoramas, read_views, source_of
from rig_protocol.camera import CameraModel
from rig_protocol.codecs import codec_by_name
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.recording import DESCRIPTION, RecordingWriter
from rig_protocol.recording_format import RecordedSet
from rig_protocol.rig_folder import CameraEntry, RigDescription

COLOR, DEPTH = codec_by_name("bayer-uncompressed"), codec_by_name("disparity-uncompressed")
SETS, PARTIAL, DAMAGED = 9, 1, 4


def encoded(camera_id: int, k: int) -> EncodedFrame:
    image = np.full((4, 6), 10 * camera_id + k, np.uint8)
    color, depth = COLOR.encode(image), DEPTH.encode(image.astype(np.uint16))
    return EncodedFrame(
        camera_id, k, k * 1000 + camera_id, 0, Payload(COLOR.id, color), Payload(DEPTH.id, depth)
    )


@pytest.fixture
def take(tmp_path: Path) -> Path:
    """Nine sets of two cameras: set 1 lacks a camera, in set 4 a frame is damaged."""
    path = tmp_path / "take.mcap"
    cameras = (CameraEntry(0, "cam00", CameraModel()), CameraEntry(1, "cam01", CameraModel()))
    with path.open("wb") as output:
        writer = RecordingWriter(output, "", 0)
        writer.attach(DESCRIPTION, RigDescription(cameras).to_dict(), 0)
        for k in range(SETS):
            frames = [encoded(0, k), replace(encoded(1, k), damaged=k == DAMAGED)]
            for frame in frames:
                writer.write(frame)
            stamps: dict[int, int | None] = {0: k * 1000, 1: None if k == PARTIAL else k * 1000 + 1}
            writer.write(RecordedSet(k, k * 1000 + 500, stamps))
        writer.finish()
    return path


def test_the_whole_sets_are_taken_in_their_order(take: Path) -> None:
    panoramas = list(read_panoramas(take, read_description(take), 7))
    assert [one.index for one in panoramas] == [0, 2, 3, 5, 6, 7, 8]
    assert source_of(take) == "recording"
    for one in panoramas:
        frame = one.frames[1]
        assert frame is not None
        assert np.array_equal(frame.raw, np.full((4, 6), 10 + one.index, np.uint16))


def test_five_sets_are_enough_where_nobody_says_how_many(take: Path) -> None:
    assert [len(view.color) for view in read_views(take, read_description(take))] == [5, 5]


def test_more_sets_than_there_are_is_a_wrong_setting(take: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"holds 7 sets .* 8 asked for"):
        list(read_panoramas(take, read_description(take), 8))


def test_what_is_no_recording_is_refused_in_words(tmp_path: Path) -> None:
    (tmp_path / "no.mcap").write_text("no")
    with pytest.raises(DataError, match="no MCAP file"):
        read_description(tmp_path / "no.mcap")
