"""Simulated agents are real processes: they come, they are watched, and none outlives the server."""

import os
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path

import pytest

from rig_protocol.errors import RigError
from rig_server import Rig
from rig_server.config import CameraSettings, RigSettings, RingSettings
from rig_server.simulation import Simulation, simulated_settings
from support.wire import KEY

START_AND_TELL = """
import sys, time
from rig_protocol.rig_key import RigKey
from rig_server.simulation import Simulation
simulation = Simulation(2, 0, 5.0, ("127.0.0.1", 9), RigKey.INSECURE)
simulation.start()
print(*(agent.pid for agent in simulation._agents.values()), flush=True)
time.sleep(60)
"""


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_simulated_cameras_come_with_the_drawing_of_their_ring_and_the_truth() -> None:
    with Rig.simulated(2, seed=3, fps=10.0, settings=RigSettings()) as rig:
        rig.wait_for_cameras(60)
        sets = (one for one in islice(rig, 100) if one.complete and len(one.frames) == 2)
        panorama = next(one for one in sets if all(f and f.gravity for f in one.frames.values()))
        assert rig.description.ring is not None
        assert rig.description.camera(1).T_rig_camera is not None
        truth = rig.true_poses()
    frame = panorama.frames[1]
    assert frame is not None
    assert frame.bayer is not None
    assert frame.bayer.shape == (480, 640)
    assert frame.raw is not None
    assert truth is not None
    assert truth.keys() == {0, 1}


def test_an_agent_that_dies_ends_the_run_with_its_log() -> None:
    simulation = Simulation(1, -1, 5.0, ("127.0.0.1", 9), KEY)  # a seed that the agent refuses
    simulation.start()
    try:
        simulation._agents[0].wait(30)
        with pytest.raises(RigError, match=r"(?s)simulated agent 0 ended with status 2.*seed"):
            simulation.check()
    finally:
        simulation.close()


def test_closing_ends_every_agent_and_is_harmless_twice() -> None:
    simulation = Simulation(2, 0, 5.0, ("127.0.0.1", 9), KEY)
    simulation.start()
    pids = [agent.pid for agent in simulation._agents.values()]
    simulation.close()
    simulation.close()
    assert not any(map(is_running, pids))


def test_no_agent_outlives_a_server_that_dies(tmp_path: Path) -> None:
    environment = os.environ | {"TMPDIR": str(tmp_path)}  # its files do outlive it
    with subprocess.Popen(
        [sys.executable, "-c", START_AND_TELL], stdout=subprocess.PIPE, text=True, env=environment
    ) as server:
        assert server.stdout is not None
        pids = [int(word) for word in server.stdout.readline().split()]
        assert len(pids) == 2
        server.kill()
        server.wait(10)
    until_s = time.monotonic() + 10
    while any(map(is_running, pids)) and time.monotonic() < until_s:
        time.sleep(0.02)
    assert not any(map(is_running, pids))


def test_a_simulated_ring_ignores_the_real_rigs_cameras_and_address() -> None:
    real = RigSettings(cameras=(CameraSettings(id=0, serial="A"),), ring=RingSettings(radius_m=0.5))
    settings = simulated_settings(real, 12)
    assert settings.cameras == ()
    assert settings.expected_cameras == 12
    assert settings.address == ("127.0.0.1", 0)
    assert settings.ring == RingSettings()
