"""With a real Kinect on this machine: pytest -m hardware."""

import time

import pytest

from rig_agent.sources.base import SourceLost
from rig_agent.sources.freenect import FreenectSettings, FreenectSource
from rig_protocol.frames import NO_DISPARITY

pytestmark = pytest.mark.hardware


def test_a_kinect_delivers_60_frames_within_5_s() -> None:
    try:
        source = FreenectSource(FreenectSettings(timeout_s=5.0))
    except SourceLost as error:
        pytest.skip(f"no usable Kinect: {error}")
    with source:
        end_s = time.monotonic() + 5
        frames = []
        while len(frames) < 60 and time.monotonic() < end_s:
            if frame := source.read(0.5):
                frames.append(frame)
        assert len(frames) == 60, source.counters
    whole = [frame for frame in frames if not frame.damaged]
    assert len(whole) > 30, "most frames lost packets: is the Kinect alone on its USB controller?"
    for frame in whole:
        assert frame.raw is not None
        assert frame.bayer is not None
        assert frame.raw.max() <= NO_DISPARITY
        assert frame.bayer.std() > 0, "an empty colour image"
    interval_s = (frames[-1].timestamp_ns - frames[0].timestamp_ns) / 59e9
    assert interval_s == pytest.approx(1 / 30, rel=0.05)
