"""What every agent recorded by itself, merged, is what their server recorded, on one clock."""

from pathlib import Path

import numpy as np

from rig_calib.merged_take import merge_takes
from rig_protocol.recording import Recording
from rig_protocol.recording_format import ClockReading
from rig_server import Rig
from rig_server.config import RigSettings
from rig_server.replay import ReplayOptions
from support.rig_processes import (
    AgentProcess,
    free_port,
    is_complete,
    server_settings,
    wait_for_set,
    write_small_rig,
)

CAMERAS, SETS = 3, 12


def test_merged_takes_of_agents_play_as_the_servers_own(tmp_path: Path) -> None:
    port, served, out = free_port(), tmp_path / "server.mcap", tmp_path / "merged.mcap"
    write_small_rig(tmp_path / "rig", CAMERAS, frames=5)
    takes = [tmp_path / f"pi{i}.mcap" for i in range(CAMERAS)]
    common = ["--source", "folder", "--path", tmp_path / "rig", "--fps", 10]
    agents = [
        AgentProcess(tmp_path / f"{i}.log", port, [*common, "--camera", i, "--record", take])
        for i, take in enumerate(takes)
    ]
    try:
        with Rig.live(server_settings(port, CAMERAS), record=served) as rig:
            for agent in agents:
                agent.start()
            for _ in range(SETS):
                wait_for_set(rig, is_complete)
            health = [camera.gauges for camera in rig.status().cameras]
        assert [agent.stop() for agent in agents] == [0] * CAMERAS
    finally:
        for agent in agents:
            agent.kill()
    assert all(one["recording"] == 1 and one["not_recorded"] == 0 for one in health)
    merged = merge_takes(takes, out)
    assert merged.clock == Recording(served).clock
    assert all(any(isinstance(e, ClockReading) for e in Recording(take).entries()) for take in takes)
    theirs, ours = (played(path) for path in (served, out))
    complete = [one for one in theirs.values() if one.complete]
    assert len(complete) >= SETS
    for key, one in theirs.items():
        if not one.complete:
            continue
        other = ours[key]
        for i in range(CAMERAS):
            mine, server = other.frames[i], one.frames[i]
            assert mine is not None
            assert server is not None
            assert np.array_equal(mine.color, server.color)
            assert np.array_equal(mine.raw, server.raw)
            known_ns = mine.uncertainty_ns + server.uncertainty_ns
            assert abs(mine.timestamp_ns - server.timestamp_ns) <= 5 * known_ns


def played(take: Path) -> dict:  # type: ignore[type-arg]
    """The sets of a take, by the agents' counts of their frames."""
    with Rig.replayed(take, RigSettings(), ReplayOptions(speed=None)) as rig:
        return {
            tuple(None if frame is None else frame.sequence for _, frame in sorted(one.frames.items())): one
            for one in rig
        }
