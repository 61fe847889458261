"""A rig of simulated agents is calibrated while it runs on and records."""

import threading
import time
from pathlib import Path

import numpy as np

from rig_calib.evaluation import evaluate
from rig_calib.recorded_calibration import calibration_for
from rig_calib.rig_calibration import RigCalibration
from rig_server import Rig
from rig_server.calibration_session import CalibrationSession, Phase
from rig_server.config import CaptureSettings, RecordingSettings, RigSettings
from rig_server.operator_actions import RigActions
from rig_server.replay import ReplayOptions
from support.rig_processes import run_program

PATIENCE_S = 240  # machines that compile the kernels for the first time, and are busy


def test_a_rig_is_calibrated_while_it_runs_on_and_its_take_brings_the_result(tmp_path: Path) -> None:
    settings = RigSettings(
        capture=CaptureSettings(frames=2), recording=RecordingSettings(folder=tmp_path / "takes")
    )
    sets: dict[Phase, int] = dict.fromkeys(Phase, 0)
    until_s = time.monotonic() + PATIENCE_S
    with Rig.simulated(3, seed=5, fps=5.0, settings=settings) as rig:
        session = CalibrationSession(rig, tmp_path / "out")
        actions = RigActions(rig, session)
        actions.start_recording("hall")
        actions.start_calibration()
        accepting: threading.Thread | None = None
        while rig.calibration is None or accepting is None or accepting.is_alive():
            assert time.monotonic() < until_s, session.view
            panorama, view = rig.next_panorama(0.25), session.view
            assert view.phase is not Phase.FAILED, view.message
            if panorama is not None:
                session.offer(panorama)
                sets[view.phase] += 1
            if view.phase is Phase.READY and accepting is None:
                assert (view.sets, view.failures, len(view.pairs)) == (2, (), 2)
                accepting = threading.Thread(target=actions.accept_calibration)
                accepting.start()
        truth = rig.true_poses()
        assert rig.next_panorama(30.0) is not None, "the rig runs on"
        assert "recorded" in actions.stop_recording()
        session.close()
    assert sets[Phase.SOLVING] > 0, "sets go on while it solves"
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"calibration.json", "report.html", "cloud.ply", "panorama.png"} <= written
    accepted = RigCalibration.load(tmp_path / "out/calibration.json")
    assert truth is not None
    absolute = evaluate(accepted, truth).absolute
    assert absolute is not None
    assert absolute.max.deg < 1.0  # two sets of a partial ring; the accuracy is measured elsewhere
    assert absolute.max.mm < 30.0
    take = tmp_path / "takes/hall.mcap"
    with Rig.replayed(take, RigSettings(), ReplayOptions(speed=None)) as replayed:
        assert replayed.calibration is not None
        assert replayed.calibration.created == accepted.created
    fused = run_program("rig_calib.cli", "fuse", take, "--out", tmp_path / "fused", "--frames", 1)
    assert fused.returncode == 0, fused.stderr
    assert np.array_equal(calibration_for(take, None).poses[2], accepted.poses[2])
