"""With a real Kinect on this machine: pytest -m hardware."""

import math
import time
from collections.abc import Iterator

import pytest

from rig_agent.sources.base import ControlRefused, SourceLost
from rig_agent.sources.freenect import FreenectSettings, FreenectSource
from rig_agent.sources.freenect_still import StillImage, take_still
from rig_agent.usb.enumerate import kinect_cameras, motor_beside, usb_devices
from rig_protocol.frames import NO_DISPARITY, RgbdFrame

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


def test_a_kinect_that_stands_level_feels_down_below_its_images() -> None:
    """Models 1473 and K4W with firmware only; of them nobody has written down the sensor's axes."""
    devices = usb_devices()
    motors = [motor_beside(camera, devices) for camera in kinect_cameras(devices)]
    if len(motors) != 1 or not motors[0].is_there:
        pytest.skip("needs one Kinect, of model 1414 or with firmware in its audio device")
    with FreenectSource(FreenectSettings(timeout_s=5.0)) as source:
        frames = [frame for frame in (source.read(1.0) for _ in range(60)) if frame is not None]
    gravity = frames[-1].gravity
    assert gravity is not None
    assert gravity.down[1] > 0.97, "stand the Kinect on a table, its motor level"


@pytest.fixture
def source() -> Iterator[FreenectSource]:
    try:
        source = FreenectSource(FreenectSettings(timeout_s=5.0))
    except SourceLost as error:
        pytest.skip(f"no usable Kinect: {error}")
    with source:
        yield source


def whole_frame(source: FreenectSource) -> RgbdFrame:
    """The next one that lost nothing, of at most 60."""
    frames = (source.read(1.0) for _ in range(60))
    return next(frame for frame in frames if frame is not None and not frame.damaged)


def test_depth_is_off_while_colour_goes_on_and_comes_back(source: FreenectSource) -> None:
    source.control("depth", False)
    assert whole_frame(source).raw is None
    source.control("depth", True)
    frames = [whole_frame(source) for _ in range(15)]
    raw = frames[-1].raw
    assert raw is not None
    assert (raw < NO_DISPARITY).mean() > 0.1, "no pattern: is the projector on, and something 1 to 3 m away?"


def test_infrared_comes_in_place_of_colour(source: FreenectSource) -> None:
    source.control("color", "ir")
    image = whole_frame(source).color
    assert image is not None
    assert image.shape == (488, 640)
    assert image.std() > 0


@pytest.mark.parametrize("step", ["stream", "device", "usb"])
def test_images_come_again_after_a_restart(source: FreenectSource, step: str) -> None:
    source.control("restart", step)
    assert whole_frame(source).raw is not None


def test_the_automatics_of_the_colour_camera_are_taken(
    source: FreenectSource, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("auto_exposure", "auto_white_balance"):
        source.control(name, False)
        source.control(name, True)
    assert "does not take flag" not in caplog.text


@pytest.mark.parametrize(("image", "shape"), [("color", (1024, 1280, 3)), ("ir", (1024, 1280))])
def test_stills_have_the_sensors_full_size(image: StillImage, shape: tuple[int, ...]) -> None:
    try:
        still = take_still(FreenectSettings(), image, high=True)
    except SourceLost as error:
        pytest.skip(f"no usable Kinect: {error}")
    assert still.shape == shape
    assert still.std() > 0


def test_a_kinect_turns_its_head_by_ten_degrees(source: FreenectSource) -> None:
    """Watch it, and its LED: it blinks meanwhile, red and yellow (1414) or green."""
    try:
        source.control("led", "blink_red_yellow")
    except ControlRefused as error:
        pytest.skip(str(error))
    felt = []
    for tilt_deg in (0, 10, 0):
        source.control("tilt_deg", tilt_deg)
        end_s = time.monotonic() + 4
        while time.monotonic() < end_s:
            frame = source.read(0.5)
        assert frame is not None
        assert frame.gravity is not None
        felt.append(math.degrees(math.asin(frame.gravity.down[2])))
    assert abs(felt[1] - felt[0]) == pytest.approx(10, abs=3)
