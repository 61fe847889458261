"""Rules of the synthetic source: free-running on a clock, as hardware is."""

from pathlib import Path

import numpy as np
import pytest

from rig_agent.simulator.ring import VirtualRig
from rig_agent.simulator.settings import SimulatorSettings
from rig_agent.sources.base import ControlRefused, FrameSource
from rig_agent.sources.synthetic import SyntheticSource
from rig_protocol.errors import ConfigurationError
from rig_protocol.frames import NO_DISPARITY, RgbdFrame
from support.virtual_time import VirtualTime

SETTINGS = SimulatorSettings(cameras=2, seed=3, frames_rendered=1)
INTERVAL_NS = 33_333_333


@pytest.fixture(scope="module")
def clock() -> VirtualTime:
    return VirtualTime(10**12)


@pytest.fixture(scope="module")
def source(clock: VirtualTime) -> FrameSource:
    """Opening renders the view, so all tests read on from one source."""
    return SyntheticSource(SETTINGS, 1, clock=clock, sleep=clock.sleep)


def read(source: FrameSource) -> RgbdFrame:
    frame = source.read(1.0)
    assert frame is not None
    return frame


def test_frames_come_at_the_rate_stamped_when_they_were_taken(
    source: FrameSource, clock: VirtualTime
) -> None:
    stamps, sequences = [], []
    for _ in range(4):
        frame = read(source)
        assert 0 <= clock.now_ns - frame.timestamp_ns < 1000
        stamps.append(frame.timestamp_ns)
        sequences.append(frame.sequence)
    assert np.diff(stamps).tolist() == [INTERVAL_NS] * 3
    assert np.diff(sequences).tolist() == [1] * 3


def test_the_phase_on_the_clock_is_the_cameras_own(source: FrameSource) -> None:
    rig = VirtualRig(SETTINGS)
    assert read(source).timestamp_ns % INTERVAL_NS == rig.camera(1).phase_ns
    assert rig.camera(0).phase_ns != rig.camera(1).phase_ns


def test_a_timeout_ends_without_a_frame_and_loses_none(source: FrameSource) -> None:
    before, skipped = read(source).sequence, source.counters["skipped"]
    assert source.read(0.001) is None
    assert read(source).sequence == before + 1
    assert source.counters["skipped"] == skipped


def test_frames_nobody_read_are_skipped_and_counted(source: FrameSource, clock: VirtualTime) -> None:
    before, skipped = read(source).sequence, source.counters["skipped"]
    clock.sleep(10.5 * INTERVAL_NS / 1e9)
    assert read(source).sequence == before + 10
    assert source.counters["skipped"] == skipped + 9


def test_the_description_is_the_factorys(source: FrameSource) -> None:
    description, kinect = source.describe(), VirtualRig(SETTINGS).camera(1)
    assert description.model.to_dict() == kinect.model.to_dict()
    assert description.model.source == "factory"
    assert (description.color_image, description.depth_image, description.fps) == ("bayer", "raw", 30.0)
    assert description.serial == kinect.serial


def test_a_camera_the_ring_lacks_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="camera 2"):
        SyntheticSource(SETTINGS, 2)


def test_depth_that_is_switched_off_is_left_out_until_it_is_on_again_and_settled(
    source: FrameSource, clock: VirtualTime
) -> None:
    source.control("depth", False)
    off = read(source)
    source.control("depth", True)
    assert off.bayer is not None
    assert off.raw is None
    assert read(source).raw is None
    clock.sleep(0.2)
    assert read(source).raw is not None


def test_neighbours_in_other_processes_see_that_a_projector_is_dark(
    clock: VirtualTime, tmp_path: Path
) -> None:
    settings = SETTINGS.model_copy(update={"projector_folder": tmp_path, "interference": 0.4})
    one, other = (SyntheticSource(settings, i, clock=clock, sleep=clock.sleep) for i in (0, 1))
    clear = VirtualRig(SETTINGS.model_copy(update={"interference": 0.0})).camera(0).frame(0).raw
    disturbed = read(one).raw
    other.control("depth", False)
    alone = read(one).raw
    other.control("depth", True)
    again = read(one).raw
    assert clear is not None
    assert disturbed is not None
    np.testing.assert_array_equal(alone, clear)
    np.testing.assert_array_equal(again, disturbed)
    assert (disturbed == NO_DISPARITY).mean() > 0.05 + (clear == NO_DISPARITY).mean()


def test_the_lamp_is_remembered(source: FrameSource) -> None:
    source.control("led", "blink_green")
    assert source.control("led", "green") == "the LED is green (was blink_green)"


def test_streams_that_are_restarted_count_from_the_start(source: FrameSource) -> None:
    read(source)
    source.control("restart", True)
    assert read(source).sequence == 0


@pytest.mark.parametrize(("name", "value"), [("tilt_deg", 4.0), ("depth", "off"), ("led", 3.0)])
def test_what_the_simulator_has_not_is_refused_and_what_it_has_named(
    source: FrameSource, name: str, value: float | str
) -> None:
    with pytest.raises(ControlRefused, match="it has led"):
        source.control(name, value)
