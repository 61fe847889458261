"""With a real OpenNI2 camera on this machine: pytest -m hardware."""

import os
import time
from itertools import pairwise

import pytest

from rig_agent.sources.base import SourceLost
from rig_agent.sources.openni2 import Openni2Settings, Openni2Source
from rig_protocol.errors import ConfigurationError
from rig_protocol.frames import RgbdFrame

pytestmark = pytest.mark.hardware


def open_camera(**settings: object) -> Openni2Source:
    """The only one; RIG_OPENNI2_REDIST names the folder of another libOpenNI2 than the system's."""
    given = {"redist": os.environ.get("RIG_OPENNI2_REDIST"), "timeout_s": 5.0, **settings}
    try:
        return Openni2Source(Openni2Settings.model_validate(given))
    except (SourceLost, ConfigurationError) as error:
        pytest.skip(f"no usable OpenNI2 camera: {error}")


def read_frames(source: Openni2Source, count: int) -> list[RgbdFrame]:
    """So many, which must come within ten seconds."""
    frames: list[RgbdFrame] = []
    end_s = time.monotonic() + 10
    while len(frames) < count and time.monotonic() < end_s:
        if frame := source.read(0.5):
            frames.append(frame)
    assert len(frames) == count, source.counters
    return frames


def test_a_camera_delivers_depth_and_colour_at_its_rate() -> None:
    with open_camera() as source:
        frames, fps = read_frames(source, 60), source.describe().fps
        counters = source.counters
    for frame in frames:
        assert frame.depth_mm is not None
        assert frame.color is not None
        assert (frame.depth_mm > 0).mean() > 0.05, "hardly any depth: is it 0.5 to 5 m from a wall?"
        assert frame.color.std() > 0, "an empty colour image"
    # The unit of time was told rightly: else the rate is wrong by a factor of 60.
    settled = frames[10:]
    interval_s = (settled[-1].timestamp_ns - settled[0].timestamp_ns) / (len(settled) - 1) / 1e9
    assert interval_s == pytest.approx(1 / fps, rel=0.05 + counters["overrun"] / 50)
    assert all(later.timestamp_ns > earlier.timestamp_ns for earlier, later in pairwise(frames))


def test_registered_depth_lies_on_the_colour_cameras_grid() -> None:
    with open_camera(registered=True) as source:
        frame = read_frames(source, 10)[-1]
    assert frame.depth_frame == "color"
    assert frame.depth_mm is not None
    assert frame.color is not None
    assert frame.depth_mm.shape == frame.color.shape[:2]


def test_a_camera_opens_again_after_it_was_closed() -> None:
    for _ in range(3):
        with open_camera() as source:
            read_frames(source, 5)
