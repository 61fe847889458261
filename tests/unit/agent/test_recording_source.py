"""Rules of the recording source: recorded images bit for bit, at the recorded pace, all agents together."""

from pathlib import Path

import numpy as np
import pytest

from rig_agent.config import AgentSettings
from rig_agent.sources import open_source
from rig_agent.sources.recording import RecordingSource
from rig_protocol.camera import CameraModel
from rig_protocol.codecs import codec_by_name
from rig_protocol.errors import ConfigurationError
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.gravity import Gravity
from rig_protocol.recording import DESCRIPTION, HELLOS, RecordingWriter
from rig_protocol.rig_folder import CameraEntry, RigDescription
from support.virtual_time import VirtualTime

COLOR, DEPTH = codec_by_name("bayer-uncompressed"), codec_by_name("disparity-uncompressed")
START_NS, INTERVAL_NS, FRAMES = 10**9, 50_000_000, 8
PERIOD_NS = (FRAMES - 1) * INTERVAL_NS + 33_333_333
FELT = Gravity((0.6, 0.8, 0.0))


@pytest.fixture
def take(tmp_path: Path) -> Path:
    path = tmp_path / "take.mcap"
    cameras = (CameraEntry(3, "left", CameraModel(source="file")), CameraEntry(4, "right", CameraModel()))
    with path.open("wb") as output:
        writer = RecordingWriter(output, "", 0)
        writer.attach(DESCRIPTION, RigDescription(cameras).to_dict(), 0)
        writer.attach(HELLOS, {"agents": [{"camera_id": 3, "fps": 20.0}]}, 0)
        for k in range(FRAMES):
            time_ns = START_NS + k * INTERVAL_NS
            image = np.full((4, 6), k, np.uint8)
            writer.write(
                EncodedFrame(
                    3,
                    100 + k,
                    time_ns,
                    color=Payload(COLOR.id, COLOR.encode(image)),
                    depth=Payload(DEPTH.id, DEPTH.encode(image.astype(np.uint16))),
                    received_ns=time_ns,
                    gravity=FELT,
                    damaged=k == 2,
                )
            )
        writer.finish()
    return path


def open_take(take: Path, time: VirtualTime, camera: int | str = 3) -> RecordingSource:
    return RecordingSource(take, camera, clock=time, sleep=time.sleep)


def test_frames_come_as_recorded_when_they_are_due_round_after_round(take: Path) -> None:
    time = VirtualTime(7 * PERIOD_NS)
    source = open_take(take, time, "left")
    for count in range(2 * FRAMES + 3):
        frame = source.read(1.0)
        number, k = divmod(count, FRAMES)
        assert frame is not None
        assert frame.timestamp_ns == time() == (7 + number) * PERIOD_NS + k * INTERVAL_NS
        assert np.array_equal(frame.bayer, np.full((4, 6), k, np.uint8))
        assert np.array_equal(frame.raw, np.full((4, 6), k, np.uint16))
        assert (frame.gravity, frame.damaged, frame.sequence) == (FELT, k == 2, count + 1)


def test_agents_that_start_at_different_times_show_the_same_moment(take: Path) -> None:
    early, late = VirtualTime(PERIOD_NS), VirtualTime(PERIOD_NS + 3 * INTERVAL_NS - 1)
    first, second = open_take(take, early), open_take(take, late)
    shown = {frame.timestamp_ns: frame.bayer for _ in range(6) if (frame := first.read(1.0)) is not None}
    frame = second.read(1.0)
    assert frame is not None
    assert np.array_equal(shown[frame.timestamp_ns], frame.bayer)


def test_frames_that_were_due_while_nobody_read_are_skipped_and_counted(take: Path) -> None:
    time = VirtualTime(PERIOD_NS)
    source = open_take(take, time)
    source.read(1.0)
    time.sleep(0.35)
    frame = source.read(1.0)
    assert frame is not None
    assert time() - frame.timestamp_ns <= 200_000_000
    assert source.counters["skipped"] == 2


def test_a_frame_that_is_not_due_in_time_is_not_given(take: Path) -> None:
    source = open_take(take, VirtualTime(PERIOD_NS))
    assert source.read(0.01) is not None
    assert source.read(0.01) is None


def test_the_recorded_camera_describes_itself(take: Path) -> None:
    told = open_take(take, VirtualTime()).describe()
    assert (told.camera_id, told.fps, told.color_image, told.depth_image) == (3, 20.0, "bayer", "raw")
    assert told.model.source == "file"


def test_a_pi_without_the_libraries_says_so(take: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    settings = AgentSettings.model_validate({"source": "recording", "camera": 3, "recording": {"path": take}})
    with pytest.raises(ConfigurationError, match="mcap and numba is missing"):
        open_source(settings)


def test_mistakes_are_named(take: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"no camera 9; it has 3 \(left\), 4 \(right\)"):
        open_take(take, VirtualTime(), 9)
    with pytest.raises(ConfigurationError, match="no frames of camera right"):
        open_take(take, VirtualTime(), 4)
    with pytest.raises(ConfigurationError, match="give --path"):
        open_source(AgentSettings(source="recording", camera=3))
