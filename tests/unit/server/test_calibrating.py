"""`--calibrate` from sets to files: a poor capture ends with status 1, its reasons, and its files."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from rig_protocol.camera import CameraModel
from rig_protocol.errors import RigError
from rig_protocol.frames import RgbdFrame
from rig_protocol.rig_folder import CameraEntry, RigDescription, write_rig_folder
from rig_server import Rig
from rig_server.calibrating import calibrate_rig
from rig_server.capture_log import CaptureLog
from rig_server.config import CaptureSettings, RigSettings
from rig_server.session_view import Phase


def test_a_result_that_fails_its_gate_says_why_and_its_files_are_written(tmp_path: Path) -> None:
    """Two cameras that look at nothing: grey walls 2 m away."""
    cameras = tuple(CameraEntry(i, f"cam{i:02d}", CameraModel()) for i in range(2))
    frames = [
        RgbdFrame(
            camera_id=i,
            sequence=0,
            timestamp_ns=0,
            color=np.full((480, 640, 3), 90, np.uint8),
            raw=np.full((480, 640), 916, np.uint16),
        )
        for i in range(2)
    ]
    write_rig_folder(tmp_path / "rig", RigDescription(cameras), frames)
    rig = Rig.open(tmp_path / "rig", RigSettings(capture=CaptureSettings(frames=3)))
    console = Console(file=io.StringIO(), width=80)
    (tmp_path / "out").mkdir()
    log = CaptureLog(wanted=3)
    with pytest.raises(RigError, match=r"fails its gate: .*cam01.*not connected"):
        calibrate_rig(rig, tmp_path / "out", console, log=log)
    assert rig.calibration is None, "what fails its gate is not in force"
    assert (log.view.phase, log.view.sets, log.view.wanted) == (Phase.READY, 1, 3)
    assert "not connected" in log.view.failures[0], "whoever looks on is told the same"
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"calibration.json", "report.html", "cloud.ply"} <= written
    result = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert result["schema"] == 1
    assert result["frames_used"] == 1
    assert result["provenance"]["source"] == "folder"
    assert "did not pass" in console.file.getvalue()  # type: ignore[attr-defined]
