"""A recorded Kinect on a virtual USB bus, through libfreenect as it is, the agent and UDP, to the server."""

import time
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from rig_protocol.frames import PanoramicFrame
from rig_server import Rig
from support.rig_processes import AgentProcess, free_port, is_complete, server_settings, wait_for_set
from support.virtual_usb.virtual_bus import VirtualBus, VirtualKinect, environment, kinect_frames

SERIAL = "A00364A11111111A"
RATE_WINDOW, ATTEMPTS = 90, 5


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def kinect(tmp_path: Path, port: int) -> Iterator[VirtualKinect]:
    """A plugged-in Kinect and the agent that serves it."""
    bus = VirtualBus(tmp_path / "usb")
    kinect = bus.add_kinect(SERIAL)
    options = ["--source", "freenect", "--camera", 0]
    agent = AgentProcess(tmp_path / "agent.log", port, options, environment(bus)).start()
    try:
        yield kinect
    finally:
        agent.kill()


def recorded_index(panorama: PanoramicFrame) -> int:
    """Which recorded frame arrived; AssertionError unless depth and colour are it, byte for byte."""
    frame = panorama.frames[0]
    assert frame is not None
    assert frame.raw is not None
    index = kinect_frames().index_of(frame.raw)
    assert index is not None, "depth is none of the recorded frames"
    np.testing.assert_array_equal(frame.bayer, kinect_frames().bayer[index])
    assert not frame.damaged
    return index


def is_gapless(panoramas: Sequence[PanoramicFrame]) -> bool:
    """True when each recorded frame is followed by the next one; all must be byte-exact."""
    indices = [recorded_index(panorama) for panorama in panoramas]
    count = len(kinect_frames().raw)
    return all((after - before) % count == 1 for before, after in pairwise(indices))


def test_recorded_frames_arrive_byte_exact_at_30_fps(kinect: VirtualKinect, port: int) -> None:
    """Three seconds without a gap; other programs may cost frames before, but never a byte."""
    with Rig.live(server_settings(port, 1)) as rig:
        wait_for_set(rig, is_complete)
        for _ in range(ATTEMPTS):
            panoramas = [wait_for_set(rig, is_complete) for _ in range(RATE_WINDOW)]
            if gapless := is_gapless(panoramas):
                break
        assert gapless, rig.status()
        # The host may be late at the bus; what was captured and sent arrives, all of it.
        assert sum(camera.lost for camera in rig.status().cameras) == 0
    elapsed_s = (panoramas[-1].timestamp_ns - panoramas[0].timestamp_ns) / 1e9
    assert (RATE_WINDOW - 1) / elapsed_s == pytest.approx(30.0, abs=0.3)
    assert kinect.log()


def test_an_unplugged_kinect_streams_again_within_5_s_of_its_return(kinect: VirtualKinect, port: int) -> None:
    with Rig.live(server_settings(port, 1)) as rig:
        wait_for_set(rig, is_complete)
        kinect.unplug()
        while rig.next_panorama(1.0) is not None:  # what was under way
            pass
        returned_s = time.monotonic()
        kinect.plug()
        recorded_index(wait_for_set(rig, is_complete, timeout_s=10))
        assert time.monotonic() - returned_s < 5.0
        assert rig.status().connected == 1
