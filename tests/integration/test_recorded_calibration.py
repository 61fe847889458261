"""Takes through the programs: calibrations replayed bit for bit, recorded cameras streamed as live ones."""

import json
from pathlib import Path

import numpy as np

from rig_calib.recorded_calibration import recorded_calibration
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.recording import Recording
from rig_server import Rig
from support.rig_processes import (
    AgentProcess,
    free_port,
    is_complete,
    run_program,
    server_settings,
    wait_for_set,
)
from support.small_agent import BAYER, RAW
from support.takes import record_take


def test_a_replayed_calibration_is_bit_identical(tmp_path: Path) -> None:
    take = tmp_path / "take.mcap"
    common = ["--calibrate", "--frames", 2]
    live = run_program(
        "rig_server.cli", *common, "--simulate", 2, "--seed", 5, "--record", take, "--out", tmp_path / "live"
    )
    copy = tmp_path / "copy.mcap"
    replayed = run_program(
        "rig_server.cli", *common, "--replay", take, "--record", copy, "--out", tmp_path / "replayed"
    )
    # Two cameras do not close the ring: the gate may say no, the files are written all the same.
    assert (tmp_path / "live/calibration.json").is_file(), live.stderr
    assert (tmp_path / "replayed/calibration.json").is_file(), replayed.stderr
    assert live.returncode == replayed.returncode
    first, second = (
        json.loads((tmp_path / name / "calibration.json").read_text()) for name in ("live", "replayed")
    )
    assert len(first["cameras"]) == 2
    assert first["cameras"] == second["cameras"]
    assert first["edges"] == second["edges"] != []
    assert second["provenance"]["source"] == "recording"
    assert first["provenance"]["agents"] == second["provenance"]["agents"] == 2
    for recorded, result in ((take, first), (copy, second)):
        brought = recorded_calibration(Recording(recorded))
        assert (brought is not None) == (live.returncode == 0), "a take brings what passes its gate"
        assert brought is None or brought.to_dict() == RigCalibration.from_dict(result).to_dict()


def test_recorded_cameras_stream_to_a_server_as_live_ones(tmp_path: Path) -> None:
    take, port = tmp_path / "take.mcap", free_port()
    record_take(take)
    agents = [
        AgentProcess(
            tmp_path / f"agent{i}.log", port, ["--source", "recording", "--path", take, "--camera", i]
        )
        for i in range(2)
    ]
    try:
        with Rig.live(server_settings(port, 2)) as rig:
            for agent in agents:
                agent.start()
            for _ in range(10):
                panorama = wait_for_set(rig, is_complete)
                for i, frame in panorama.frames.items():
                    assert frame is not None
                    assert np.array_equal(frame.bayer, BAYER)
                    assert np.array_equal(frame.raw, RAW + i)
    finally:
        for agent in agents:
            agent.kill()
