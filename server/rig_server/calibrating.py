"""`rig-server --calibrate`: collect panoramic frames, calibrate, write the files, print the tables."""

import time
from collections.abc import Mapping
from pathlib import Path

from rich.console import Console

from rig_calib.evaluation import evaluate
from rig_calib.outputs import keep_before, write_outputs
from rig_calib.rig_calibration import RigCalibration
from rig_calib.terminal import calibration_tables, evaluation_table, progress_bar
from rig_protocol.errors import RigError
from rig_protocol.poses import Pose
from rig_protocol.rig_folder import write_true_poses
from rig_protocol.troubleshooting import Topic
from rig_server.calibration_task import CalibrationTask, Estimate
from rig_server.capture_log import CaptureLog
from rig_server.coach import Coach, Coaches, counted
from rig_server.coach_display import CoachDisplay
from rig_server.coached_capture import coached_capture
from rig_server.rig import Rig


def calibrate_rig(
    rig: Rig,
    folder: Path,
    console: Console,
    task: CalibrationTask | None = None,
    log: CaptureLog | None = None,
) -> None:
    """Wait for the cameras, collect, calibrate, write the files, print the tables.

    RigError when cameras do not come, when the result fails its gate, and when it misses the task's target
    (the files are written in the last two cases, too). The default task is the whole rig; `log`: for whoever
    looks on. A recording embeds a result that passes its gate.
    """
    task = task or CalibrationTask.whole_rig(rig.settings)
    started_s = time.monotonic()
    with CoachDisplay(console) as display, rig:
        coach = display if log is None else Coaches(display, log)
        _wait_for_cameras(rig, coach)
        truth = rig.true_poses()
        estimate = coached_capture(rig, task, coach)
        calibrated_s = time.monotonic()
        calibration = task.stamped(estimate, rig.hellos, rig.source)
        if not calibration.failures:
            rig.put_in_force(calibration)
    if log is not None:
        log.ready()
    if task.known is not None:
        keep_before(folder)
    with progress_bar(console) as tell:
        result = estimate.result
        write_outputs(folder, calibration, estimate.views, result.evidence, result.poses_before, tell)
    console.print(calibration_tables(calibration, estimate.views))
    console.print(
        f"wrote calibration.json, report.html, cloud.ply, panorama.png to {folder}; "
        f"capture and calibration {calibrated_s - started_s:.1f} s, "
        f"pictures {time.monotonic() - calibrated_s:.1f} s",
        soft_wrap=True,
    )
    if truth is not None and calibration.cameras:
        _compare(calibration, truth, folder, console)
    _judge(task, estimate, console)


def _wait_for_cameras(rig: Rig, coach: Coach) -> None:
    expected = rig.settings.expected_cameras or len(rig.settings.cameras) or None
    rig.wait_for_cameras(
        rig.settings.capture.wait_s, lambda status: coach.connected(status.connected, expected)
    )
    connected = rig.status().connected
    coach.connected(connected, connected)


def _judge(task: CalibrationTask, estimate: Estimate, console: Console) -> None:
    """RigError when the gate or the target says no."""
    troubles = []
    if estimate.calibration.failures:
        troubles.append("the calibration fails its gate: " + "; ".join(estimate.calibration.failures))
    if estimate.missed is not None:
        troubles.append(f"the calibration misses its target: {estimate.missed}")
    if troubles:
        raise RigError("; ".join(troubles), Topic.CALIBRATION_REFUSED)
    if task.target is not None:
        console.print(f"the target is met on {counted(estimate.sets, 'set')}")


def _compare(calibration: RigCalibration, truth: Mapping[int, Pose], folder: Path, console: Console) -> None:
    write_true_poses(folder / "truth.json", truth)
    console.print(evaluation_table(evaluate(calibration, truth)))
