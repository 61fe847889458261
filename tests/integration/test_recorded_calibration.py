"""A take of the simulated rig: a replayed calibration is the live one, bit for bit."""

import json
from pathlib import Path

from support.rig_processes import run_program


def test_a_replayed_calibration_is_bit_identical(tmp_path: Path) -> None:
    take = tmp_path / "take.mcap"
    common = ["--calibrate", "--frames", 2]
    live = run_program(
        "rig_server.cli", *common, "--simulate", 2, "--seed", 5, "--record", take, "--out", tmp_path / "live"
    )
    replayed = run_program("rig_server.cli", *common, "--replay", take, "--out", tmp_path / "replayed")
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
