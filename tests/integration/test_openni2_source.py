"""The openni2 source on virtual devices, under the unmodified libOpenNI2: images, time, identity, loss."""

import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from rig_agent.sources.base import ControlRefused, SourceLost
from rig_agent.sources.openni2 import Openni2Settings, Openni2Source
from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.frames import RgbdFrame
from support.openni_driver.virtual_devices import VirtualDevices, device_images, redist

FRAME_INTERVAL_NS = 1e9 / 30


def open_source(**settings: object) -> Openni2Source:
    """With the virtual devices' drivers."""
    return Openni2Source(Openni2Settings.model_validate({"redist": redist(), **settings}))


def next_frame(source: Openni2Source) -> RgbdFrame:
    """The next one, which must come."""
    frame = source.read(3.0)
    assert frame is not None, source.counters
    return frame


def index_of(frame: RgbdFrame) -> int:
    """Which images of the device these are; colour and depth must be of one index, byte for byte."""
    images = device_images()
    assert frame.color is not None
    index = images.index_of(frame.color)
    assert index is not None, "colour is none of the device's images"
    expected = images.registered if frame.depth_frame == "color" else images.depth
    np.testing.assert_array_equal(frame.depth_mm, expected[index])
    return index


def read_until_lost(source: Openni2Source, limit_s: float) -> SourceLost:
    """Read on until the source gives up."""
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        try:
            source.read(0.1)
        except SourceLost as error:
            return error
    raise AssertionError(f"the loss went unnoticed for {limit_s} s")


def test_frames_arrive_byte_exact_and_paired_at_30_fps(openni_devices: VirtualDevices) -> None:
    openni_devices.add()
    with open_source() as source:
        frames = [next_frame(source) for _ in range(60)]
        counters = source.counters
    indices = [index_of(frame) for frame in frames]
    missing = sum((later - earlier - 1) % 6 for earlier, later in pairwise(indices))
    assert missing == counters["overrun"], "a frame vanished without being counted"
    assert [frame.sequence for frame in frames] == list(range(60))
    assert all(frame.depth_frame == "depth" for frame in frames)
    settled, count = frames[10:], sum((b - a) % 6 for a, b in pairwise(indices[10:]))
    duration_ns = settled[-1].timestamp_ns - settled[0].timestamp_ns
    assert count / duration_ns * 1e9 == pytest.approx(30, abs=0.3)


def test_registered_depth_is_the_devices_and_says_whose_grid_it_is_on(openni_devices: VirtualDevices) -> None:
    device = openni_devices.add()
    with open_source(registered=True) as source:
        frame = next_frame(source)
        model = source.describe().model
    assert frame.depth_frame == "color"
    index_of(frame)
    assert (model.depth, model.T_color_depth) == (None, None)
    assert "registration on" in device.log()


def test_a_device_that_cannot_register_says_which_setting_to_leave_out(
    openni_devices: VirtualDevices,
) -> None:
    openni_devices.add().clear("registered.bin")
    with pytest.raises(ConfigurationError, match="leave out `registered`"):
        open_source(registered=True)
    with open_source() as source:
        index_of(next_frame(source))


def test_tenths_of_millimetres_are_rounded_to_millimetres(openni_devices: VirtualDevices) -> None:
    openni_devices.add().write("depth_unit", "100um")
    with open_source() as source:
        frame = next_frame(source)
    assert frame.color is not None
    index = device_images().index_of(frame.color)
    assert index is not None
    tenths = device_images().depth[index].astype(np.float64)
    np.testing.assert_array_equal(frame.depth_mm, np.floor(tenths / 10 + 0.5))


@pytest.mark.parametrize("mirror", ["until told", "always"])
def test_images_are_never_mirrored(openni_devices: VirtualDevices, mirror: str) -> None:
    openni_devices.add().write("mirror", mirror)
    with open_source() as source:
        index_of(next_frame(source))


@pytest.mark.parametrize("clock", ["us", "ticks"])
def test_time_follows_the_device_in_either_unit_and_across_the_counters_wrap(
    openni_devices: VirtualDevices, clock: str
) -> None:
    device = openni_devices.add()
    device.write("clock", clock)
    device.write("first_tick", str(2**32 - 60_000_000))  # wraps a second after it is opened
    with open_source() as source:
        frames = [next_frame(source) for _ in range(50)]
        arrived_ns = time.monotonic_ns()
    steps = np.diff([frame.timestamp_ns for frame in frames])[10:]
    frames_passed = np.round(steps / FRAME_INTERVAL_NS)
    assert frames_passed.max() < 10
    # The offset may still improve by a few times its uncertainty.
    tolerance_ns = 1_000_000 + 3 * max(frame.uncertainty_ns for frame in frames[10:])
    np.testing.assert_allclose(steps, frames_passed * FRAME_INTERVAL_NS, atol=tolerance_ns)
    assert 0 < arrived_ns - frames[-1].timestamp_ns < 1e9


def test_the_camera_model_follows_from_the_fields_of_view_and_is_a_default(
    openni_devices: VirtualDevices,
) -> None:
    openni_devices.add()
    with open_source() as source:
        description = source.describe()
    assert description.model.source == "default"
    assert description.model.depth is not None
    assert description.model.depth.fx == pytest.approx(320 / np.tan(1.0210 / 2), rel=1e-5)
    assert description.model.color.fy == pytest.approx(240 / np.tan(0.7959 / 2), rel=1e-5)
    assert (description.color_image, description.depth_image, description.fps) == ("bgr", "depth_mm", 30.0)
    assert description.serial == "SN-a"


def test_a_device_without_fields_of_view_or_serial_number_gets_defaults(
    openni_devices: VirtualDevices,
) -> None:
    device = openni_devices.add()
    device.write("no_fov")
    device.clear("serial")
    with open_source() as source:
        description = source.describe()
    assert description.serial is None
    assert description.model.color.fx == 525.0


@pytest.mark.parametrize("sensor", ["color.bin", "depth.bin"])
def test_a_device_with_one_sensor_delivers_what_it_has(openni_devices: VirtualDevices, sensor: str) -> None:
    openni_devices.add().clear(sensor)
    with open_source() as source:
        frame, description = next_frame(source), source.describe()
    assert (frame.color is None, frame.depth_mm is None) == (sensor == "color.bin", sensor == "depth.bin")
    assert (description.color_image is None) == (frame.color is None)
    assert (description.depth_image is None) == (frame.depth_mm is None)


@pytest.mark.parametrize("choice", [{"serial": "SN-b"}, {"uri": "virtual://b"}])
def test_a_device_is_found_by_serial_number_or_uri(
    openni_devices: VirtualDevices, choice: dict[str, str]
) -> None:
    for name in "abc":
        openni_devices.add(name)
    with open_source(**choice) as source:
        assert source.describe().serial == "SN-b"
        index_of(next_frame(source))


def test_an_unclear_choice_names_the_devices(openni_devices: VirtualDevices) -> None:
    openni_devices.add("a")
    openni_devices.add("b").clear("serial")
    with pytest.raises(ConfigurationError, match=r"2 devices, virtual://a, virtual://b.*`uri` or `serial`"):
        open_source()
    with pytest.raises(SourceLost, match=r"no OpenNI2 device X.*virtual://a \(SN-a\), .*choose it by `uri`"):
        open_source(serial="X")
    with pytest.raises(SourceLost, match=r"no OpenNI2 device virtual://x is connected, but virtual://a"):
        open_source(uri="virtual://x")


def test_two_choices_at_once_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="only one of `recording`, `uri` and `serial`"):
        open_source(uri="virtual://a", serial="SN-a")


def test_no_device_says_what_to_check(openni_devices: VirtualDevices) -> None:
    assert openni_devices.folder.exists()
    with pytest.raises(SourceLost, match=r"sees no device: check cable and power.*FreenectDriver"):
        open_source()


def test_a_device_that_does_not_open_is_a_loss_that_may_pass(openni_devices: VirtualDevices) -> None:
    device = openni_devices.add()
    device.write("deny")
    with pytest.raises(SourceLost, match="virtual://a cannot be opened"):
        open_source()
    device.clear("deny")
    with open_source() as source:
        index_of(next_frame(source))


def test_a_second_source_in_one_process_is_refused_and_harms_nothing(openni_devices: VirtualDevices) -> None:
    openni_devices.add("a")
    openni_devices.add("b")
    with open_source(uri="virtual://a") as source:
        with pytest.raises(RigError, match="one rig-agent for each device"):
            open_source(uri="virtual://b")
        index_of(next_frame(source))


def test_images_that_stop_coming_are_a_loss_after_the_time_out(openni_devices: VirtualDevices) -> None:
    device = openni_devices.add()
    with open_source(timeout_s=0.5) as source:
        next_frame(source)
        device.write("stall")
        assert "no frame for 0.5 s" in str(read_until_lost(source, limit_s=3.0))


def test_unplugging_is_noticed_at_once_and_the_device_opens_again_when_it_is_back(
    openni_devices: VirtualDevices,
) -> None:
    device = openni_devices.add()
    source = open_source()
    next_frame(source)
    device.unplug()
    assert "is gone" in str(read_until_lost(source, limit_s=1.0))
    source.close()
    with pytest.raises(SourceLost, match="sees no device"):
        open_source()
    device.plug()
    with open_source() as source:
        index_of(next_frame(source))


def test_a_replug_too_quick_to_see_in_the_images_is_a_loss_too(openni_devices: VirtualDevices) -> None:
    device = openni_devices.add()
    with open_source() as source:
        next_frame(source)
        device.unplug()
        time.sleep(0.05)  # a few scans of the driver
        device.plug()
        read_until_lost(source, limit_s=1.0)


def test_thirty_plugs_and_unplugs_leak_no_thread_descriptor_or_device(
    openni_devices: VirtualDevices,
) -> None:
    device = openni_devices.add()

    def cycle() -> None:
        device.plug()
        with open_source() as source:
            next_frame(source)
            device.unplug()
            read_until_lost(source, limit_s=2.0)

    def held() -> tuple[int, int]:
        tasks, descriptors = Path("/proc/self/task"), Path("/proc/self/fd")
        return len(list(tasks.iterdir())), len(list(descriptors.iterdir()))

    cycle()
    before = held()
    for _ in range(30):
        cycle()
    assert held() <= before
    assert device.log().count("open") == device.log().count("close") == 31
    assert threading.active_count() <= before[0]


def test_a_control_is_refused_and_harms_nothing(openni_devices: VirtualDevices) -> None:
    openni_devices.add()
    with open_source() as source:
        with pytest.raises(ControlRefused, match="cannot set led to red"):
            source.control("led", "red")
        index_of(next_frame(source))


def test_reading_a_closed_source_is_a_loss_and_closing_twice_is_harmless(
    openni_devices: VirtualDevices,
) -> None:
    openni_devices.add()
    source = open_source()
    source.close()
    source.close()
    with pytest.raises(SourceLost, match="closed"):
        source.read(0.1)


def run_in_child(program: str, *options: str, env: dict[str, str] | None = None) -> str:
    """What a fresh interpreter prints: libOpenNI2 is loaded once a process."""
    done = subprocess.run(
        [sys.executable, *options, "-c", program], capture_output=True, text=True, check=True, env=env
    )
    return done.stdout


OPEN_AND_TELL = """
from pathlib import Path
from rig_agent.sources.openni2 import Openni2Settings, Openni2Source
from rig_protocol.errors import RigError
{before}
try:
    Openni2Source(Openni2Settings(redist={redist!r}))
except RigError as error:
    print(type(error).__name__, error)
"""


def test_a_missing_library_says_how_to_install_it(tmp_path: Path) -> None:
    redist()  # skips without the package
    told = run_in_child(OPEN_AND_TELL.format(before="", redist=str(tmp_path)))
    assert told.startswith("ConfigurationError libOpenNI2 cannot be loaded")
    assert "apt install libopenni2-0" in told


def test_a_missing_python_package_says_how_to_install_it() -> None:
    told = run_in_child(OPEN_AND_TELL.format(before="import sys; sys.modules['openni'] = None", redist=None))
    assert "pip install 'kinect-rig[openni]'" in told


def test_a_library_without_drivers_says_where_they_belong(tmp_path: Path) -> None:
    (tmp_path / "libOpenNI2.so.0").symlink_to((redist() / "libOpenNI2.so.0").resolve())
    told = run_in_child(OPEN_AND_TELL.format(before="", redist=str(tmp_path)))
    assert told.startswith("ConfigurationError OpenNI2 does not start"), told
    assert "OpenNI2/Drivers" in told


PLAY_DUMMY = """
from rig_agent.sources.openni2 import Openni2Settings, Openni2Source
for _ in range(3):
    with Openni2Source(Openni2Settings(uri="Dummy")) as source:
        frame = source.read(3.0)
        print(frame.depth_mm.shape, frame.color.shape, source.describe().model.color.fx)
"""


def test_a_driver_that_leaves_a_thread_behind_does_not_crash_the_agent() -> None:
    """OpenNI2's own Dummy; its images are half as large, and so is the default focal length."""
    if not any(Path("/usr/lib").glob("*/OpenNI2/Drivers/libDummyDevice.so.0")):
        pytest.skip("this OpenNI2 brings no Dummy driver: apt install libopenni2-0")
    redist()
    assert run_in_child(PLAY_DUMMY).split("\n")[:3] == ["(240, 320) (240, 320, 3) 262.5"] * 3


def test_the_systems_library_needs_no_setting(tmp_path: Path) -> None:
    redist()
    assert tmp_path.exists()
    told = run_in_child(OPEN_AND_TELL.format(before="", redist=None))
    assert told == "" or told.startswith("SourceLost"), told
