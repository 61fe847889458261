"""A virtual OpenNI2 device and a recording, through libOpenNI2, a real agent and UDP, to the server."""

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from rig_protocol.frames import PanoramicFrame
from rig_server import Rig
from support.oni_writer import DEPTH_1_MM, RGB888, OniWriter
from support.openni_driver.virtual_devices import VirtualDevice, VirtualDevices, device_images, redist
from support.rig_processes import AgentProcess, free_port, is_complete, server_settings, wait_for_set


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def devices(tmp_path: Path) -> VirtualDevices:
    return VirtualDevices(tmp_path / "devices", fps=10)


@pytest.fixture
def device(devices: VirtualDevices) -> VirtualDevice:
    return devices.add()


@contextmanager
def running_agent(
    devices: VirtualDevices, logs: Path, port: int, *options: object, **settings: object
) -> Iterator[AgentProcess]:
    """An agent with the openni2 source."""
    given = {f"RIG_AGENT_OPENNI2__{key.upper()}": str(value) for key, value in settings.items()}
    env = devices.environment() | {"RIG_AGENT_OPENNI2__REDIST": str(redist())} | given
    words = ["--source", "openni2", "--camera", 0, *options]
    agent = AgentProcess(logs / "agent.log", port, words, env).start()
    try:
        yield agent
    finally:
        agent.kill()


def check_images(panorama: PanoramicFrame) -> str:
    """AssertionError unless its colour and depth are the device's, bit for bit; whose grid depth is on."""
    frame = panorama.frames[0]
    assert frame is not None
    assert frame.color is not None
    images = device_images()
    index = images.index_of(frame.color)
    assert index is not None, "colour is none of the device's images"
    expected = images.registered if frame.depth_frame == "color" else images.depth
    np.testing.assert_array_equal(frame.depth_mm, expected[index])
    return frame.depth_frame


def test_frames_reach_the_server_bit_by_bit_and_ctrl_c_ends_the_agent_in_order(
    devices: VirtualDevices, device: VirtualDevice, tmp_path: Path, port: int
) -> None:
    with (
        running_agent(devices, tmp_path, port) as agent,
        Rig.live(server_settings(port, 1)) as rig,
    ):
        for _ in range(10):
            assert check_images(wait_for_set(rig, is_complete)) == "depth"
        agent.send_signal(signal.SIGINT)
        assert agent.wait() == 0
    assert "Traceback" not in agent.log
    assert device.log().count("close") == 1


def test_registered_depth_is_known_as_such_at_the_server(
    devices: VirtualDevices, device: VirtualDevice, tmp_path: Path, port: int
) -> None:
    with (
        running_agent(devices, tmp_path, port, registered="true"),
        Rig.live(server_settings(port, 1)) as rig,
    ):
        assert check_images(wait_for_set(rig, is_complete)) == "color"
    assert "registration on" in device.log()


def test_an_unplugged_device_streams_again_within_5_s_of_its_return(
    devices: VirtualDevices, device: VirtualDevice, tmp_path: Path, port: int
) -> None:
    with (
        running_agent(devices, tmp_path, port) as agent,
        Rig.live(server_settings(port, 1)) as rig,
    ):
        wait_for_set(rig, is_complete)
        device.unplug()
        agent.wait_for_log(r"is gone \(cable or power\?\); trying again until it is back")
        while rig.next_panorama(1.0) is not None:  # what was under way
            pass
        returned_s = time.monotonic()
        device.plug()
        check_images(wait_for_set(rig, is_complete, timeout_s=10))
        assert time.monotonic() - returned_s < 5.0
        assert rig.status().connected == 1


def test_a_recording_streams_by_its_option(devices: VirtualDevices, tmp_path: Path, port: int) -> None:
    images = device_images()
    with OniWriter(tmp_path / "office.oni", [DEPTH_1_MM, RGB888], fps=10) as writer:
        for i in range(6):
            writer.write(1, 100_000 * i, images.depth[i])
            writer.write(2, 100_000 * i + 2000, images.color_rgb[i])
    options = ["--recording", tmp_path / "office.oni"]
    with running_agent(devices, tmp_path, port, *options), Rig.live(server_settings(port, 1)) as rig:
        for _ in range(5):
            check_images(wait_for_set(rig, is_complete))


def test_a_torn_recording_ends_the_agent_with_one_sentence(
    devices: VirtualDevices, tmp_path: Path, port: int
) -> None:
    (tmp_path / "torn.oni").write_bytes(b"NI10" + bytes(60))
    with running_agent(devices, tmp_path, port, "--recording", tmp_path / "torn.oni") as agent:
        assert agent.wait() == 1
    assert "torn.oni is torn or damaged at byte 24" in agent.log
    assert "Traceback" not in agent.log
