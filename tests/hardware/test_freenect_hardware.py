"""With a real Kinect on this machine: pytest -m hardware."""

import time

import pytest

from rig_agent.sources.base import SourceLost
from rig_agent.sources.freenect import FreenectSettings, FreenectSource
from rig_agent.usb.enumerate import kinect_cameras, motor_beside, usb_devices
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


def test_a_1414_that_stands_level_feels_down_below_its_images() -> None:
    """Models 1473 and K4W tell nothing of it."""
    devices = usb_devices()
    motors = [motor_beside(camera, devices) for camera in kinect_cameras(devices)]
    if len(motors) != 1 or motors[0] is None:
        pytest.skip("needs one Kinect, of model 1414")
    with FreenectSource(FreenectSettings(timeout_s=5.0)) as source:
        frames = [frame for frame in (source.read(1.0) for _ in range(60)) if frame is not None]
    gravity = frames[-1].gravity
    assert gravity is not None
    assert gravity.down[1] > 0.97, "stand the Kinect on a table, its motor level"
