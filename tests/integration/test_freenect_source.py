"""The freenect source on virtual Kinects, under the unmodified libfreenect: images, time, identity."""

import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest

from rig_agent.sources.freenect import COUNTERS, FreenectSettings, FreenectSource
from rig_protocol.errors import ConfigurationError
from rig_protocol.frames import RgbdFrame
from rig_protocol.gravity import Gravity
from support.virtual_usb.virtual_bus import KinectFrames, VirtualBus, environment, kinect_frames

FRAME_INTERVAL_NS = 1e9 / 30


def frames_of(source: FreenectSource, seconds: float) -> list[RgbdFrame]:
    """Everything that arrives within this time."""

    def arriving() -> Iterator[RgbdFrame]:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            if frame := source.read(0.5):
                yield frame

    return list(arriving())


def index_in(recorded: KinectFrames, frame: RgbdFrame) -> int:
    """Which recorded frame this is; both images must be it, byte for byte."""
    assert frame.raw is not None
    assert frame.bayer is not None
    index = recorded.index_of(frame.raw)
    assert index is not None, "depth is none of the recorded images"
    assert np.array_equal(frame.bayer, recorded.bayer[index]), "colour belongs to another frame"
    return index


def test_real_frames_arrive_byte_exact_and_paired_at_30_fps(usb_bus: VirtualBus) -> None:
    usb_bus.add_kinect("A00364A11111111A")
    with FreenectSource(FreenectSettings()) as source:
        frames = frames_of(source, seconds=2.5)
        counters = source.counters
    indices = [index_in(kinect_frames(), frame) for frame in frames]
    missing = sum((later - earlier - 1) % 12 for earlier, later in pairwise(indices))
    assert missing == counters["overrun"], "a frame vanished without being counted"
    assert counters == {**dict.fromkeys(COUNTERS, 0), "overrun": missing}
    assert [frame.sequence for frame in frames] == list(range(len(frames)))
    duration_ns = frames[-1].timestamp_ns - frames[0].timestamp_ns
    assert duration_ns > 2e9
    assert (len(frames) + missing - 1) / duration_ns * 1e9 == pytest.approx(30, abs=0.3)
    assert missing <= 0.05 * len(frames)


def test_stamps_follow_the_device_clock_and_lie_before_their_arrival(usb_bus: VirtualBus) -> None:
    usb_bus.add_kinect("A00364A11111111A")
    with FreenectSource(FreenectSettings()) as source:
        frames = []
        for _ in range(30):
            frame = source.read(1.0)
            assert frame is not None
            assert frame.timestamp_ns <= time.monotonic_ns()
            frames.append(frame)
    settled = frames[10:]
    steps = [later.timestamp_ns - earlier.timestamp_ns for earlier, later in pairwise(settled)]
    # Packets travel in slots of 125 µs; the offset may still improve by a few times its uncertainty.
    tolerance_ns = 125_000 + 3 * max(frame.uncertainty_ns for frame in settled)
    assert steps == pytest.approx([FRAME_INTERVAL_NS] * len(steps), abs=tolerance_ns)


def test_time_goes_on_when_the_device_counter_wraps(usb_bus: VirtualBus) -> None:
    kinect = usb_bus.add_kinect("A00364A11111111A", plugged=False)
    kinect.write("first_tick", str(2**32 - 60_000_000))  # wraps one second after power-on
    kinect.plug()
    with FreenectSource(FreenectSettings()) as source:
        frames = frames_of(source, seconds=1.6)
    steps = [later.timestamp_ns - earlier.timestamp_ns for earlier, later in pairwise(frames)]
    assert max(steps) < 2 * FRAME_INTERVAL_NS
    assert min(steps) > 0


def test_factory_data_gives_the_depth_model(usb_bus: VirtualBus) -> None:
    usb_bus.add_kinect("A00364A11111111A")
    with FreenectSource(FreenectSettings()) as source:
        model = source.describe().model
    assert model.source == "default", "the factory data is silent about the colour camera: it is not measured"
    assert model.depth is not None
    assert model.depth.fx == pytest.approx(575.8, abs=0.05)  # 120 / (2 × 0.1042)
    assert model.raw_model.numerator_m == pytest.approx(345.489, abs=0.001)
    assert model.raw_model.offset == pytest.approx(1089.41, abs=0.01)


@pytest.mark.parametrize("model", ["1414", "1473", "K4W"])
def test_every_model_is_known_by_the_serial_number_on_its_label(usb_bus: VirtualBus, model: str) -> None:
    usb_bus.add_kinect("A00000000000000A")
    kinect = usb_bus.add_kinect("B50123456789012B", model=model.lower())
    with FreenectSource(FreenectSettings(serial=kinect.serial)) as source:
        description = source.describe()
        assert source.read(2.0) is not None
    assert (description.serial, description.port_path) == (kinect.serial, kinect.port_path)


@pytest.mark.parametrize("port_path", ["1-2", "1-2.1"])
def test_a_kinect_is_found_by_its_port_or_the_port_of_its_camera(usb_bus: VirtualBus, port_path: str) -> None:
    for serial in ("A00000000000000A", "A00000000000000B", "A00000000000000C"):
        usb_bus.add_kinect(serial, model="1473")
    with FreenectSource(FreenectSettings(port_path=port_path)) as source:
        assert source.describe().serial == "A00000000000000B"


def test_the_right_kinect_opens_when_an_earlier_one_may_not_be_read(usb_bus: VirtualBus) -> None:
    usb_bus.add_kinect("A00000000000000A").write("deny")
    wanted = usb_bus.add_kinect("A00000000000000B")
    with FreenectSource(FreenectSettings(serial=wanted.serial)) as source:
        assert source.read(2.0) is not None
    assert any(line.startswith("register 0006=0002") for line in wanted.log())


def test_several_kinects_without_a_choice_are_a_configuration_error(usb_bus: VirtualBus) -> None:
    usb_bus.add_kinect("A00000000000000A")
    usb_bus.add_kinect("A00000000000000B")
    with pytest.raises(ConfigurationError, match=r"2 Kinects.*A0+A.*A0+B.*`serial` or `port_path`"):
        FreenectSource(FreenectSettings())


def wait_for_gravity(source: FreenectSource) -> Gravity | None:
    """What the frames tell once they tell it, or None after 90 of them."""
    for _ in range(90):
        frame = source.read(1.0)
        assert frame is not None
        if frame.gravity is not None:
            return frame.gravity
    return None


def test_frames_tell_which_way_is_down_by_the_kinects_own_accelerometer(usb_bus: VirtualBus) -> None:
    usb_bus.add_kinect("B50123456789012B", model="1473")  # before it on the bus, and without a motor
    usb_bus.add_kinect("A00364A11111111A").write("accel", "819 0 0 0 0")
    kinect = usb_bus.add_kinect("A00364A22222222A")
    kinect.write("accel", "0 800 -180 0 0")
    with FreenectSource(FreenectSettings(serial=kinect.serial)) as source:
        gravity = wait_for_gravity(source)
    assert gravity is not None
    np.testing.assert_allclose(gravity.down, (0, 0.976, 0.220), atol=0.001)
    assert kinect.open_handles() == 0


@pytest.mark.parametrize("model", ["1473", "K4W"])
def test_later_models_feel_by_their_audio_device_once_firmware_runs_in_it(
    usb_bus: VirtualBus, model: str
) -> None:
    kinect = usb_bus.add_kinect("B50123456789012B", model=model.lower())
    kinect.write("accel", "0 800 -180 0 0")
    with FreenectSource(FreenectSettings()) as source:
        gravity = wait_for_gravity(source)
    assert gravity is not None
    np.testing.assert_allclose(gravity.down, (0, 0.976, 0.220), atol=0.001)
    assert kinect.open_handles() == 0


@pytest.mark.parametrize("model", ["1414", "1473", "K4W"])
def test_a_motor_that_never_answers_costs_no_frame(usb_bus: VirtualBus, model: str) -> None:
    usb_bus.add_kinect("A00364A11111111A", model=model.lower()).write("mute_motor")
    with FreenectSource(FreenectSettings()) as source:
        frames = frames_of(source, seconds=1.5)
        counters = source.counters
    assert all(frame.gravity is None for frame in frames)
    assert counters["unpaired"] == counters["damaged"] == 0
    # Whoever waited for the motor would lose a quarter of a second, seven frames, each time.
    assert len(frames) + counters["overrun"] > 36


def test_a_child_process_finds_the_virtual_bus_in_place_of_the_machines(usb_bus: VirtualBus) -> None:
    kinect = usb_bus.add_kinect("A00364A11111111A")
    program = (
        "from rig_agent.sources.freenect import COUNTERS, FreenectSettings, FreenectSource\n"
        "with FreenectSource(FreenectSettings()) as source:\n"
        "    print(source.describe().serial, source.read(2.0).raw.shape)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment(usb_bus), capture_output=True, text=True, check=True
    )
    assert done.stdout.split("\n")[0] == f"{kinect.serial} (480, 640)"
