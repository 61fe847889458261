"""What a Kinect can be told while it streams, on virtual Kinects under the unmodified libfreenect."""

from collections.abc import Iterator

import numpy as np
import pytest

from rig_agent.sources.base import ControlRefused, SourceLost
from rig_agent.sources.freenect import FreenectSettings, FreenectSource
from rig_protocol.frames import RgbdFrame
from support.virtual_usb.virtual_bus import VirtualBus, VirtualKinect, infrared_frames, kinect_frames

FRAMES = 8


@pytest.fixture
def kinect(usb_bus: VirtualBus) -> VirtualKinect:
    kinect = usb_bus.add_kinect("A00364A11111111A", plugged=False)
    infrared_frames().write(kinect)
    kinect.plug()
    return kinect


@pytest.fixture
def source(kinect: VirtualKinect) -> Iterator[FreenectSource]:
    with FreenectSource(FreenectSettings(serial=kinect.serial)) as source:
        yield source


def next_frame(source: FreenectSource) -> RgbdFrame:
    frame = source.read(2.0)
    assert frame is not None
    return frame


def test_colour_goes_on_byte_exact_while_depth_and_projector_are_off(
    source: FreenectSource, kinect: VirtualKinect
) -> None:
    next_frame(source)
    starts = kinect.log().count("register 0005=0001")
    source.control("depth", False)
    assert kinect.log()[-1] == "register 0006=0000", "the projector is on"
    alone = [next_frame(source) for _ in range(FRAMES)]
    for frame in alone:
        assert frame.raw is None
        assert any(np.array_equal(frame.bayer, bayer) for bayer in kinect_frames().bayer)
    source.control("depth", True)
    together = [next_frame(source) for _ in range(FRAMES)]
    for frame in together:
        assert frame.raw is not None
        index = kinect_frames().index_of(frame.raw)
        assert index is not None
        assert np.array_equal(frame.bayer, kinect_frames().bayer[index])
    assert kinect.log().count("register 0005=0001") == starts, "the colour stream was disturbed"
    frames = alone + together
    assert [frame.sequence for frame in frames] == list(range(1, 2 * FRAMES + 1))
    times_ns = [frame.timestamp_ns for frame in frames]
    assert times_ns == sorted(times_ns)
    assert source.counters["unpaired"] <= 1, "switching is no fault"


def test_infrared_images_come_in_place_of_colour_and_are_described_so(source: FreenectSource) -> None:
    assert source.describe().color_image == "bayer"
    source.control("color", "ir")
    assert source.describe().color_image == "grey"
    frame = next_frame(source)
    assert frame.bayer is None
    assert frame.raw is not None
    assert frame.color is not None
    assert any(np.array_equal(frame.color, image) for image in infrared_frames().grey)
    source.control("color", "bayer")
    assert source.describe().color_image == "bayer"
    assert next_frame(source).bayer is not None


def test_demosaiced_images_have_the_colours_of_the_scene(source: FreenectSource) -> None:
    source.control("color", "rgb")
    assert source.describe().color_image == "bgr"
    color = next_frame(source).color
    assert color is not None
    assert color.shape == (480, 640, 3)
    bayer = kinect_frames().bayer[0]
    blue, red = bayer[1::2, 0::2].mean(), bayer[0::2, 1::2].mean()
    assert color[..., 0].mean() == pytest.approx(blue, abs=1)
    assert color[..., 2].mean() == pytest.approx(red, abs=1)


@pytest.mark.parametrize("value", ["off", "green", "red", "yellow", "blink_green", "blink_red_yellow"])
def test_the_led_shows_what_it_is_told(source: FreenectSource, kinect: VirtualKinect, value: str) -> None:
    codes = {"off": 0, "green": 1, "red": 2, "yellow": 3, "blink_green": 4, "blink_red_yellow": 6}
    source.control("led", value)
    assert [line for line in kinect.log() if line.startswith("led")][-1] == f"led {codes[value]}"


def test_the_led_is_lit_while_the_kinect_streams_and_out_afterwards(kinect: VirtualKinect) -> None:
    with FreenectSource(FreenectSettings(led="yellow")) as source:
        next_frame(source)
    assert [line for line in kinect.log() if line.startswith("led")] == ["led 3", "led 0"]


@pytest.mark.parametrize(("value", "half_degrees"), [(10.0, 20), (-27, -54), ("12.5", 25)])
def test_tilt_is_told_in_degrees_above_the_horizon(
    source: FreenectSource, kinect: VirtualKinect, value: float | str, half_degrees: int
) -> None:
    assert "above the horizon" in source.control("tilt_deg", value)
    assert kinect.log()[-1] == f"tilt {half_degrees}"


def test_led_and_tilt_reach_the_motor_of_the_same_kinect(usb_bus: VirtualBus) -> None:
    other = usb_bus.add_kinect("A00364A11111111A")
    wanted = usb_bus.add_kinect("A00364A22222222A")
    with FreenectSource(FreenectSettings(serial=wanted.serial)) as source:
        source.control("tilt_deg", 5)
    assert "tilt 10" in wanted.log()
    assert not [line for line in other.log() if line.startswith(("tilt", "led"))]


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("tilt_deg", 28, "from -27 to 27"),
        ("tilt_deg", "nan", "from -27 to 27"),
        ("tilt_deg", "up", "a number of degrees"),
        ("led", "blue", "one of off, green, red"),
        ("color", "yuv", "one of bayer, rgb, ir"),
        ("depth", "maybe", "true or false"),
        ("near_mode", True, "only a Kinect for Windows"),
        ("restart", "everything", "one of stream, device, usb"),
        ("zoom", 2, "no control zoom: it has led, tilt_deg"),
    ],
)
def test_what_a_kinect_cannot_do_is_refused_in_words_and_harms_nothing(
    source: FreenectSource, name: str, value: float | str, words: str
) -> None:
    with pytest.raises(ControlRefused, match=words):
        source.control(name, value)
    next_frame(source)


@pytest.mark.parametrize("model", ["1473", "K4W"])
@pytest.mark.parametrize(("name", "value"), [("led", "red"), ("tilt_deg", 3)])
def test_later_models_without_firmware_refuse_led_and_tilt_and_send_images(
    usb_bus: VirtualBus, model: str, name: str, value: float | str
) -> None:
    usb_bus.add_kinect("A00364A11111111A")
    kinect = usb_bus.add_kinect("B50123456789012B", model=model.lower(), plugged=False)
    kinect.write("no_firmware")
    kinect.plug()
    with FreenectSource(FreenectSettings(serial=kinect.serial)) as source:
        with pytest.raises(ControlRefused, match="want firmware"):
            source.control(name, value)
        assert next_frame(source).gravity is None


@pytest.mark.parametrize("model", ["1473", "K4W"])
def test_later_models_with_firmware_are_told_by_their_own_audio_device(
    usb_bus: VirtualBus, model: str
) -> None:
    others = [usb_bus.add_kinect("A00364A11111111A"), usb_bus.add_kinect("B50111111111111B", model="1473")]
    kinect = usb_bus.add_kinect("B50123456789012B", model=model.lower())
    with FreenectSource(FreenectSettings(serial=kinect.serial)) as source:
        assert source.control("led", "red") == "the LED is red"
        assert source.control("led", "blink_red_yellow").endswith(f"nearest that a {model} has")
        assert source.control("tilt_deg", -7.4) == "the Kinect turns to -7 degrees above the horizon"
        next_frame(source)
    told = [line for line in kinect.log() if line.startswith("audio ")]
    green, red, blink_green, off = (f"audio led {code}" for code in (3, 4, 2, 1))
    by_libfreenect = [green]  # at every opening
    assert told == [*by_libfreenect, green, red, blink_green, "audio tilt -7", off]
    assert not [line for other in others for line in other.log() if "tilt" in line or "led" in line]


def test_near_mode_is_switched_on_a_k4w(usb_bus: VirtualBus) -> None:
    kinect = usb_bus.add_kinect("B50123456789012B", model="k4w")
    with FreenectSource(FreenectSettings()) as source:
        source.control("near_mode", True)
        assert kinect.log()[-2:] == ["register 0015=0007", "register 02ef=0000"]
        source.control("near_mode", False)
        assert kinect.log()[-2:] == ["register 0015=001e", "register 02ef=0190"]


@pytest.mark.parametrize(("name", "bit"), [("auto_exposure", 1 << 14), ("auto_white_balance", 1 << 1)])
def test_the_colour_cameras_automatics_are_switched_one_by_one(
    source: FreenectSource, kinect: VirtualKinect, name: str, bit: int
) -> None:
    both = 1 << 14 | 1 << 1
    source.control(name, False)
    assert kinect.log()[-1] == f"cmos 0106={both & ~bit:04x}"
    source.control(name, True)
    assert kinect.log()[-1] == f"cmos 0106={both:04x}"


def test_automatics_belong_to_the_colour_camera(source: FreenectSource) -> None:
    source.control("color", "ir")
    with pytest.raises(ControlRefused, match="infrared is on"):
        source.control("auto_exposure", False)


def test_a_mirror_holds_for_both_images_and_through_a_restart_of_a_stream(
    source: FreenectSource, kinect: VirtualKinect
) -> None:
    source.control("mirror", True)
    assert kinect.log()[-2:] == ["register 0047=0001", "register 0017=0001"]
    source.control("restart", "stream")
    log = kinect.log()
    assert log.index("register 0006=0002") < len(log) - 2
    assert log[-2:] == ["register 0047=0001", "register 0017=0001"], "libfreenect starts streams unmirrored"


@pytest.mark.parametrize(
    ("step", "counter"),
    [("stream", "stream_restarts"), ("device", "device_restarts"), ("usb", "usb_resets")],
)
def test_a_restart_on_request_counts_and_images_come_again(
    source: FreenectSource, kinect: VirtualKinect, step: str, counter: str
) -> None:
    before = next_frame(source)
    source.control("restart", step)
    after = next_frame(source)
    assert (after.sequence, source.counters[counter]) == (before.sequence + 1, 1)
    assert after.timestamp_ns > before.timestamp_ns
    assert kinect.log().count("reset Xbox NUI Camera") == (step == "usb")


def test_settings_tell_the_kinect_at_once_and_packed_depth_is_the_same_depth(kinect: VirtualKinect) -> None:
    settings = FreenectSettings(depth_format="11bit_packed", auto_exposure=False, mirror=True)
    with FreenectSource(settings) as source:
        for _ in range(FRAMES):
            frame = next_frame(source)
            assert frame.raw is not None
            assert kinect_frames().index_of(frame.raw) is not None
    log = kinect.log()
    assert "register 0047=0001" in log
    assert [line for line in log if line.startswith("cmos")][-1] == "cmos 0106=0002"


def test_a_kinect_that_stops_answering_is_lost_and_not_waited_for(kinect: VirtualKinect) -> None:
    with FreenectSource(FreenectSettings(timeout_s=0.5)) as source:
        kinect.write("mute")
        with pytest.raises(SourceLost, match=r"did not answer within 0\.5 s"):
            source.control("depth", False)
    assert "reset Xbox NUI Camera" in kinect.log()


def test_what_the_kinect_does_not_take_is_refused_and_costs_nothing_else(kinect: VirtualKinect) -> None:
    kinect.write("deaf_sensor")
    with FreenectSource(FreenectSettings()) as source:
        for _ in range(2):
            with pytest.raises(ControlRefused, match="does not take auto_exposure = false"):
                source.control("auto_exposure", False)
        source.control("mirror", True)
        next_frame(source)


def test_an_unplugged_kinect_loses_a_control_at_once(source: FreenectSource, kinect: VirtualKinect) -> None:
    kinect.unplug()
    with pytest.raises(SourceLost, match="libfreenect cannot"):
        source.control("depth", False)
