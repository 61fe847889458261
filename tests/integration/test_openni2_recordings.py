"""Recordings of OpenNI2 through its own player: our writer's and its recorder's, whole, torn and foreign."""

import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from rig_agent.sources.openni2 import Openni2Settings, Openni2Source
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import RgbdFrame
from support.oni_writer import DEPTH_1_MM, DEPTH_100_UM, RGB888, OniWriter, PixelFormat
from support.openni_driver.virtual_devices import VirtualDevices, device_images, redist

COUNT = 6
INTERVAL_US = 1e6 / 30


def write_recording(
    path: Path,
    frames: int = COUNT,
    *,
    depth: PixelFormat = DEPTH_1_MM,
    units_per_us: int = 1,
    interval_us: float = INTERVAL_US,
    mirrored: bool = False,
) -> Path:
    """The virtual device's images at 30 frames/s, colour 2 ms after depth."""
    images = device_images()
    step = -1 if mirrored else 1
    with OniWriter(path, [depth, RGB888], mirrored=mirrored) as writer:
        for i in range(frames):
            stamp_us = 1000 + round(i * interval_us)
            writer.write(1, stamp_us * units_per_us, images.depth[i % COUNT, :, ::step])
            writer.write(2, (stamp_us + 2000) * units_per_us, images.color_rgb[i % COUNT, :, ::step])
    return path


def play(recording: Path, **settings: object) -> Openni2Source:
    """Through OpenNI2's player alone."""
    values = {"redist": redist(), "recording": recording, "playback": "as_fast_as_read", **settings}
    return Openni2Source(Openni2Settings.model_validate(values))


def read_frames(source: Openni2Source, count: int) -> list[RgbdFrame]:
    """So many, which must come."""
    frames = [source.read(3.0) for _ in range(count)]
    assert all(frames), source.counters
    return [frame for frame in frames if frame]


def indices_of(frames: Sequence[RgbdFrame]) -> list[int | None]:
    """Which recorded frames these are; depth must belong to colour, byte for byte."""
    images = device_images()
    indices = [images.index_of(frame.color) for frame in frames if frame.color is not None]
    for frame, index in zip(frames, indices, strict=True):
        assert index is not None, "colour is none of the recorded images"
        np.testing.assert_array_equal(frame.depth_mm, images.depth[index])
    return indices


def test_a_recording_plays_byte_exact_and_whole_over_and_over(tmp_path: Path) -> None:
    with play(write_recording(tmp_path / "a.oni")) as source:
        indices = indices_of(read_frames(source, 3 * COUNT))
        assert source.counters == {"unpaired": 0, "overrun": 0}
        description = source.describe()
    start = indices[0] or 0
    assert indices == [(start + i) % COUNT for i in range(3 * COUNT)]
    assert (description.fps, description.serial, description.model.source) == (30.0, None, "default")
    assert description.model.depth is not None
    assert description.model.depth.fx == pytest.approx(320 / np.tan(1.01447 / 2), rel=1e-4)


@pytest.mark.parametrize("units_per_us", [1, 60])
def test_in_real_time_frames_are_due_at_the_pace_of_their_stamps(tmp_path: Path, units_per_us: int) -> None:
    recording = write_recording(tmp_path / "a.oni", units_per_us=units_per_us)
    with play(recording, playback="real_time") as source:
        frames = read_frames(source, 2 * COUNT)
        ended_ns = time.monotonic_ns()
    steps_ns = np.diff([frame.timestamp_ns for frame in frames])
    late = steps_ns > 1.5e9 / 30  # a busy machine: the player goes on from there
    np.testing.assert_allclose(steps_ns[~late], 1e9 / 30, atol=20_000)
    assert late.sum() <= 2
    assert ended_ns >= frames[-1].timestamp_ns, "a frame came before it was due"


def test_as_fast_as_read_waits_for_nothing(tmp_path: Path) -> None:
    with play(write_recording(tmp_path / "a.oni", interval_us=300_000)) as source:
        frames = read_frames(source, 12)
    assert frames[-1].timestamp_ns - frames[0].timestamp_ns < 3e9, "the recording lasts longer"


def test_a_recording_of_one_frame_plays(tmp_path: Path) -> None:
    with play(write_recording(tmp_path / "a.oni", frames=1)) as source:
        assert indices_of(read_frames(source, 3)) == [0, 0, 0]


def test_a_mirrored_recording_is_turned_round(tmp_path: Path) -> None:
    with play(write_recording(tmp_path / "a.oni", mirrored=True)) as source:
        indices_of(read_frames(source, COUNT))


def test_tenths_of_millimetres_in_a_recording_are_rounded(tmp_path: Path) -> None:
    with play(write_recording(tmp_path / "a.oni", depth=DEPTH_100_UM)) as source:
        (frame,) = read_frames(source, 1)
    assert frame.color is not None
    index = device_images().index_of(frame.color)
    assert index is not None
    tenths = device_images().depth[index].astype(np.float64)
    np.testing.assert_array_equal(frame.depth_mm, np.floor(tenths / 10 + 0.5))


def test_the_operator_tells_that_a_recording_is_registered(tmp_path: Path) -> None:
    with play(write_recording(tmp_path / "a.oni"), registered=True) as source:
        (frame,) = read_frames(source, 1)
        assert source.describe().model.depth is None
    assert frame.depth_frame == "color"


RECORD = """
import os, sys
from openni import _openni2, openni2
redist, path = sys.argv[1:]
_openni2.load_dll(redist + "/libOpenNI2.so.0")
openni2.loaded_dll_directory = redist
openni2.initialize()
device = openni2.Device(None)
streams = [device.create_depth_stream(), device.create_color_stream()]
recorder = openni2.Recorder(path.encode())
for stream in streams:
    recorder.attach(stream)
recorder.start()
for stream in streams:
    stream.start()
for _ in range(24):
    openni2.wait_for_any_stream(streams, 2.0).read_frame().close()
recorder.stop()
recorder.close()  # before its streams, or it crashes
os._exit(0)  # as unloading does at times
"""


def test_what_opennis_own_recorder_wrote_plays_byte_exact(
    openni_devices: VirtualDevices, tmp_path: Path
) -> None:
    """Its recorder counts each stream's time from that stream's own first image.

    Where one stream began a frame later, on a busy machine, colour and depth of one stamp are a frame apart
    for the whole take, and nothing in the file tells. Every image must still come, in step.
    """
    openni_devices.add()
    path = tmp_path / "recorded.oni"
    subprocess.run(
        [sys.executable, "-c", RECORD, str(redist()), str(path)],
        env=openni_devices.environment(),
        check=True,
        timeout=60,
    )
    with play(path) as source:
        frames = read_frames(source, 10)
    images = device_images()
    color = [images.index_of(frame.color) for frame in frames if frame.color is not None]
    depth = [images.depth_index_of(frame.depth_mm) for frame in frames if frame.depth_mm is not None]
    assert None not in color
    assert None not in depth
    apart = {
        ((of_color or 0) - (of_depth or 0)) % COUNT for of_color, of_depth in zip(color, depth, strict=True)
    }
    assert len(apart) == 1, (color, depth)


def test_a_torn_recording_says_where(tmp_path: Path) -> None:
    whole = write_recording(tmp_path / "a.oni").read_bytes()
    torn = tmp_path / "torn.oni"
    for length in (30, 500, len(whole) // 2, len(whole) - 10):
        torn.write_bytes(whole[:length])
        with pytest.raises(DataError, match=rf"torn\.oni is torn or damaged at byte \d+ of {length}"):
            play(torn)


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n" * 20, b"NI1"])
def test_a_foreign_file_is_no_recording(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.oni").write_bytes(content)
    with pytest.raises(DataError, match=r"a\.oni is no OpenNI recording"):
        play(tmp_path / "a.oni")


def test_a_recording_without_images_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="holds no images"):
        play(write_recording(tmp_path / "a.oni", frames=0))


def test_a_missing_recording_is_a_configuration_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"a\.oni cannot be read: No such file"):
        play(tmp_path / "a.oni")


def test_a_recording_that_the_player_will_not_deliver_says_so(tmp_path: Path) -> None:
    """OpenNI2 drops every image of a stream whose cropping it does not know, and says nothing."""
    path = write_recording(tmp_path / "a.oni")
    path.write_bytes(path.read_bytes().replace(b"xnCropping\0", b"xnCropped!\0"))
    with play(path, timeout_s=0.5) as source, pytest.raises(DataError, match=r"no frame for 0\.5 s"):
        source.read(5.0)


def test_a_recording_that_states_an_empty_image_is_refused(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "a.oni")
    stated, empty = struct.pack("<III", 640, 480, 30), struct.pack("<III", 640, 0, 30)
    path.write_bytes(path.read_bytes().replace(stated, empty))
    with play(path) as source, pytest.raises(DataError, match="not as large as it says"):
        source.read(3.0)
