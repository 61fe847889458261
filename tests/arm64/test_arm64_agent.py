"""Rules of an agent on a Pi's processor, emulated: installed from wheels, it streams what it is given.

`make arm64-test`; needs root, `apt install debootstrap qemu-user-static gcc-aarch64-linux-gnu
libusb-1.0-0-dev`, and answers from Debian's mirror and the package index. The server runs natively.
"""

import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from rig_agent.simulator.ring import VirtualRig
from rig_agent.simulator.settings import SimulatorSettings
from rig_protocol.frames import RgbdFrame
from rig_server import Rig
from support.arm64_root import COMPILER, Arm64Root, missing
from support.key_for_tests import rig_key_file
from support.pi_wheels import index_answers
from support.rig_processes import AgentProcess, free_port, is_complete, server_settings, wait_for_set
from support.virtual_usb import virtual_bus

REPOSITORY = Path(__file__).resolve().parents[2]
WORK = REPOSITORY / "build" / "arm64-test"
FRAMES, SLOW_FPS = 20, 2.0
PATIENCE_S = 300.0
# Vector units differ in the last bit of a sine: here and there a value rounds the other way.
COLOR_STEPS, COLOR_SHARE = 3, 1e-4

pytestmark = [
    pytest.mark.arm64,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(missing() is not None, reason=missing() or ""),
]


class Pi:
    """An arm64 root with the agent installed."""

    def __init__(self) -> None:
        self.root = Arm64Root(WORK / "root")
        self.rig_agent = self.root.install_agent()
        shutil.copy(rig_key_file(), self.root.path / "srv/rig.key")

    @contextmanager
    def agent(self, port: int, environment: Mapping[str, str], *options: object) -> Iterator[AgentProcess]:
        """`rig-agent` of the root, until the block ends; its log is in build/arm64-test."""
        log = WORK / "agent.log"
        log.unlink(missing_ok=True)
        agent = AgentProcess(
            log,
            port,
            ["--key-file", "/srv/rig.key", "--camera", 0, *options],
            {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", **environment},
            prefix=self.root.enter(),
            program=self.rig_agent,
        ).start()
        try:
            yield agent
        finally:
            agent.kill()


@pytest.fixture(scope="module")
def pi() -> Pi:
    if not index_answers():
        pytest.skip("no package index answers: the agent is installed from wheels that pip downloads")
    WORK.mkdir(parents=True, exist_ok=True)
    return Pi()


def received(rig: Rig) -> list[RgbdFrame]:
    """The next frames of camera 0, in order; none of them flagged."""
    begin_s, frames = time.monotonic(), []
    while len(frames) < FRAMES:
        frame = wait_for_set(rig, is_complete, PATIENCE_S).frames[0]
        assert frame is not None
        assert not frame.damaged
        frames.append(frame)
    lost = sum(camera.lost for camera in rig.status().cameras)
    print(f"{FRAMES} frames in {time.monotonic() - begin_s:.1f} s, {lost} lost")
    return frames


def test_the_agent_runs_on_the_other_processor(pi: Pi) -> None:
    python, _ = pi.rig_agent
    assert pi.root.run(python, "-c", "import platform; print(platform.machine())") == "aarch64\n"


def test_the_simulated_camera_sees_the_same_there_and_here(pi: Pi) -> None:
    settings = SimulatorSettings(cameras=2, frames_rendered=3, fps=SLOW_FPS)
    environment = {
        "RIG_AGENT_SYNTHETIC__CAMERAS": "2",
        "RIG_AGENT_SYNTHETIC__FRAMES_RENDERED": "3",
        "RIG_AGENT_SYNTHETIC__FPS": str(SLOW_FPS),
    }
    port = free_port()
    with (
        Rig.live(server_settings(port, 1)) as rig,
        pi.agent(port, environment, "--source", "synthetic"),
    ):
        frames = received(rig)
    kinect = VirtualRig(settings).camera(0)
    for frame in frames:
        here = kinect.frame(frame.sequence)
        assert frame.bayer is not None
        assert here.bayer is not None
        np.testing.assert_array_equal(frame.raw, here.raw)
        steps = np.abs(frame.bayer.astype(int) - here.bayer)
        print(f"frame {frame.sequence}: {np.count_nonzero(steps)} pixels differ, by up to {steps.max()}")
        assert steps.max() <= COLOR_STEPS
        assert np.count_nonzero(steps) <= COLOR_SHARE * steps.size


def test_a_kinect_arrives_byte_exact_through_arm64_libfreenect(pi: Pi) -> None:
    generator = np.random.default_rng(0)
    shown = virtual_bus.KinectFrames(
        generator.integers(0, 256, (4, 480, 640), dtype=np.uint8),
        generator.integers(0, 2047, (4, 480, 640), dtype=np.uint16),
    )
    shutil.rmtree(pi.root.path / "srv/usb", ignore_errors=True)
    bus = virtual_bus.VirtualBus(pi.root.path / "srv/usb", SLOW_FPS)
    bus.add_kinect("A00364A11111111A", frames=shown)
    shutil.copy(virtual_bus.compiled(COMPILER), pi.root.path / "srv")
    environment = {"LD_LIBRARY_PATH": "/srv", "VKINECT_DIR": "/srv/usb", "VKINECT_FPS": str(SLOW_FPS)}
    port = free_port()
    with (
        Rig.live(server_settings(port, 1)) as rig,
        pi.agent(port, environment, "--source", "freenect"),
    ):
        frames = received(rig)
    indices = [shown.index_of(frame.raw) for frame in frames]
    assert None not in indices, "depth is none of the images on the bus"
    for index, frame in zip(indices, frames, strict=True):
        np.testing.assert_array_equal(frame.bayer, shown.bayer[index])
    assert len(set(indices)) == len(shown.raw)
