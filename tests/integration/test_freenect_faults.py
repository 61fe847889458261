"""The freenect source when things go wrong: absent, forbidden, unplugged, silent, lossy Kinects."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rig_agent.capture import Capture
from rig_agent.sources import freenect
from rig_agent.sources.base import SourceLost
from rig_agent.sources.freenect import FreenectSettings, FreenectSource
from rig_agent.sources.freenect_formats import DepthName
from rig_agent.usb import enumerate as usb_enumerate
from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.frames import RgbdFrame
from support.virtual_usb.virtual_bus import VirtualBus, VirtualKinect, kinect_frames

SERIAL = "A00364A11111111A"
IMPATIENT = FreenectSettings(timeout_s=0.5)


@pytest.fixture(autouse=True)
def _nothing_untold() -> None:
    freenect._untold.clear()


@pytest.fixture
def kinect(usb_bus: VirtualBus) -> Iterator[VirtualKinect]:
    kinect = usb_bus.add_kinect(SERIAL)
    yield kinect
    kinect.unplug()  # frees a thread that a failed test left in libfreenect


def read_until_lost(source: FreenectSource, limit_s: float) -> SourceLost:
    """Read on until the source gives up."""
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        try:
            source.read(0.1)
        except SourceLost as error:
            return error
    raise AssertionError(f"the loss went unnoticed for {limit_s} s")


def freenect_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "freenect"]


def test_no_kinect_says_what_to_check(usb_bus: VirtualBus) -> None:
    assert usb_bus.folder.exists()
    with pytest.raises(SourceLost, match="check the cable and the Kinect's own power supply"):
        FreenectSource(FreenectSettings())


def test_a_wrong_serial_number_names_those_that_are_there(kinect: VirtualKinect) -> None:
    with pytest.raises(SourceLost, match=rf"no Kinect A1 is connected, but Kinect {kinect.serial}"):
        FreenectSource(FreenectSettings(serial="A1"))


def test_missing_permission_names_the_udev_rule(kinect: VirtualKinect) -> None:
    kinect.write("deny")
    with pytest.raises(SourceLost, match=r"may not be opened \(/dev/bus/usb/\d+/\d+\).*udev"):
        FreenectSource(FreenectSettings())


def test_a_camera_in_use_names_the_likely_culprits(kinect: VirtualKinect) -> None:
    kinect.write("busy")
    with pytest.raises(SourceLost, match=r"in use by another program.*gspca_kinect"):
        FreenectSource(FreenectSettings())


def test_a_second_source_on_one_kinect_is_refused_and_harms_nothing(kinect: VirtualKinect) -> None:
    with FreenectSource(FreenectSettings(serial=kinect.serial)) as source:
        with pytest.raises(SourceLost, match="in use"):
            FreenectSource(FreenectSettings(serial=kinect.serial))
        assert source.read(2.0) is not None


def test_a_missing_library_says_how_to_install_it(kinect: VirtualKinect) -> None:
    assert kinect.serial
    with pytest.raises(ConfigurationError, match=r"apt install libfreenect0\.5"):
        FreenectSource(FreenectSettings(library=Path("/nonexistent/libfreenect.so")))


def test_unplugging_is_noticed_at_once_and_replugging_recovers_within_5_s(kinect: VirtualKinect) -> None:
    source = FreenectSource(FreenectSettings())
    assert source.read(2.0) is not None
    kinect.unplug()
    assert SERIAL in str(read_until_lost(source, limit_s=1.0))
    source.close()
    with pytest.raises(SourceLost, match="no Kinect"):
        FreenectSource(FreenectSettings())
    plugged_s = time.monotonic()
    kinect.plug()
    with FreenectSource(FreenectSettings()) as source:
        assert source.read(2.0) is not None
        assert time.monotonic() - plugged_s < 5


def test_a_replug_too_quick_to_see_is_a_loss_too(kinect: VirtualKinect) -> None:
    with FreenectSource(FreenectSettings()) as source:
        assert source.read(2.0) is not None
        kinect.unplug()
        kinect.plug()
        read_until_lost(source, limit_s=1.0)


def read_until_counted(source: FreenectSource, counter: str, limit_s: float = 5.0) -> None:
    """Read on until the source has taken this step once."""
    end_s = time.monotonic() + limit_s
    while source.counters[counter] == 0:
        source.read(0.1)
        assert time.monotonic() < end_s, f"no step {counter} within {limit_s} s"


def test_a_silent_kinect_climbs_the_ladder_and_each_step_is_logged_and_counted(
    kinect: VirtualKinect, caplog: pytest.LogCaptureFixture
) -> None:
    with FreenectSource(IMPATIENT) as source:
        assert source.read(2.0) is not None
        kinect.write("stall")
        with pytest.raises(RigError, match="whatever was tried: start the agent anew") as end:
            read_until_lost(source, limit_s=15.0)
        counters = source.counters
    assert not isinstance(end.value, SourceLost), "trying again in this process cannot help"
    assert (counters["stream_restarts"], counters["device_restarts"], counters["usb_resets"]) == (1, 1, 1)
    steps = [record.message for record in caplog.records if "no images for 0.5 s" in record.message]
    assert [step.split("; ")[1] for step in steps] == [
        "its streams were restarted",
        "it was opened anew",
        "its USB port was reset",
    ]
    assert kinect.log().count("reset Xbox NUI Camera") == 1
    assert kinect.open_handles() == 0


def test_a_stream_that_came_back_begins_the_ladder_at_its_foot(kinect: VirtualKinect) -> None:
    with FreenectSource(IMPATIENT) as source:
        for restarts in (1, 2):
            assert source.read(2.0) is not None
            kinect.write("stall")
            end_s = time.monotonic() + 5
            while source.counters["stream_restarts"] < restarts and time.monotonic() < end_s:
                source.read(0.1)
            kinect.clear("stall")
        assert source.read(2.0) is not None
        assert source.counters["stream_restarts"] == 2
        assert source.counters["device_restarts"] == 0


def test_what_the_operator_set_outlives_the_ladder(kinect: VirtualKinect) -> None:
    with FreenectSource(IMPATIENT) as source:
        source.control("depth", False)
        source.control("mirror", True)
        kinect.write("stall")
        read_until_counted(source, "device_restarts")
        kinect.clear("stall")
        frame = source.read(2.0)
        assert frame is not None
        assert frame.raw is None
    assert kinect.log().count("register 0047=0001") >= 2, "mirrored after the reopening, too"


def test_a_camera_that_never_answers_does_not_hang_opening(kinect: VirtualKinect) -> None:
    kinect.write("mute")
    began_s = time.monotonic()
    with pytest.raises(SourceLost, match=r"did not answer within 0\.5 s"):
        FreenectSource(IMPATIENT)
    assert time.monotonic() - began_s < 5
    assert "reset Xbox NUI Camera" in kinect.log()
    with FreenectSource(IMPATIENT) as source:
        assert source.read(2.0) is not None, "the reset did not help"
        assert source.counters["usb_resets"] == 1, "the source that could not open did not live to tell"


def test_a_camera_that_stops_answering_does_not_hang_closing(kinect: VirtualKinect) -> None:
    source = FreenectSource(IMPATIENT)
    kinect.write("mute")
    began_s = time.monotonic()
    source.close()
    assert time.monotonic() - began_s < 6
    assert "reset Xbox NUI Camera" in kinect.log()
    assert freenect_threads() == []


def test_a_camera_beyond_help_asks_for_a_new_process(
    kinect: VirtualKinect, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(usb_enumerate, "reset", lambda _camera: None)
    monkeypatch.setattr(freenect, "_STOP_LIMIT_S", 0.3)
    source = FreenectSource(IMPATIENT)
    kinect.write("mute")
    source.close()
    with pytest.raises(RigError, match="start the agent anew") as refusal:
        FreenectSource(IMPATIENT)
    assert not isinstance(refusal.value, SourceLost), "trying again in this process cannot help"
    kinect.unplug()  # sets the thread free
    for thread in freenect_threads():
        thread.join(5)
    kinect.plug()
    kinect.clear("mute")
    with FreenectSource(FreenectSettings()) as source:
        assert source.read(2.0) is not None


@pytest.mark.parametrize("fault", ["deny", "busy", "mute", "stall", "unplugged"])
def test_the_agent_has_images_again_once_a_fault_is_mended(kinect: VirtualKinect, fault: str) -> None:
    failed, whole = threading.Event(), threading.Event()
    told: list[Exception] = []

    def open_source() -> FreenectSource:
        try:
            return FreenectSource(IMPATIENT)
        except SourceLost:
            failed.set()
            raise

    def take(_: RgbdFrame) -> None:
        whole.set()

    if fault == "unplugged":
        kinect.unplug()
    else:
        kinect.write(fault)
    capture = Capture(open_source, None, lambda _: None, take, told.append)
    capture.start()
    if fault == "stall":  # it opens, and is silent
        assert not whole.wait(0.3)
    else:
        assert failed.wait(10)
    kinect.clear(fault)
    if fault == "unplugged":
        kinect.plug()
    assert whole.wait(20)
    assert capture.stop(10)
    assert told == []


@pytest.mark.parametrize("stream", ["video", "depth"])
@pytest.mark.parametrize("packet", [0, 100, -1])
def test_a_frame_with_a_lost_packet_is_flagged_and_its_neighbours_are_not(
    kinect: VirtualKinect, stream: str, packet: int
) -> None:
    last = {"video": 161, "depth": 241}[stream]
    kinect.write(f"lose_{stream}_packet", f"{last if packet < 0 else packet} 4")  # of frames 0, 4, 8 of 12
    recorded = kinect_frames()
    with FreenectSource(FreenectSettings()) as source:
        frames = [source.read(2.0) for _ in range(24)]
        assert source.counters["damaged"] == sum(frame.damaged for frame in frames if frame)
    for frame in frames:
        assert frame is not None
        assert frame.raw is not None
        if not frame.damaged:
            index = recorded.index_of(frame.raw)
            assert index is not None
            assert np.array_equal(frame.bayer, recorded.bayer[index])
            assert index % 4 != 0, "a frame that lost a packet passed as whole"
    damaged = sum(frame.damaged for frame in frames if frame)
    assert damaged in (5, 6, 7), "every fourth frame lost a packet, no other did"


@pytest.mark.parametrize("depth_format", ["11bit", "11bit_packed"])
def test_random_packet_loss_never_yields_a_torn_frame_without_flag(
    kinect: VirtualKinect, depth_format: DepthName
) -> None:
    kinect.write("lose", "0.2")
    recorded = kinect_frames()
    whole = 0
    with FreenectSource(FreenectSettings(depth_format=depth_format)) as source:
        for _ in range(60):
            frame = source.read(2.0)
            assert frame is not None
            assert frame.raw is not None
            if frame.damaged:
                continue
            index = recorded.index_of(frame.raw)
            assert index is not None, "torn depth without flag"
            assert np.array_equal(frame.bayer, recorded.bayer[index]), "torn colour without flag"
            whole += 1
        assert source.counters["damaged"] > 10
        assert source.counters["unreported"] == 0
    assert whole > 10


def test_reopening_twenty_times_leaks_no_thread_handle_or_descriptor(kinect: VirtualKinect) -> None:
    def reopen() -> None:
        with FreenectSource(FreenectSettings()) as source:
            assert source.read(2.0) is not None

    reopen()
    descriptors = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(20):
        reopen()
    assert freenect_threads() == []
    assert kinect.open_handles() == 0
    assert len(list(Path("/proc/self/fd").iterdir())) <= descriptors
