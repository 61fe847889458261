"""`rig-server --calibrate`: collect panoramic frames, calibrate, write the files, print the tables."""

import time
from collections.abc import Mapping
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from rig_calib.evaluation import evaluate
from rig_calib.outputs import write_outputs
from rig_calib.rig_calibration import RigCalibration
from rig_calib.terminal import calibration_tables, evaluation_table, progress_bar
from rig_protocol.errors import RigError
from rig_protocol.poses import Pose
from rig_protocol.rig_folder import write_true_poses
from rig_server.rig import Rig
from rig_server.sinks.calibrate import CalibrateSink, with_agents

_POLL_S = 0.5


def calibrate_rig(rig: Rig, folder: Path, console: Console) -> None:
    """Wait for the cameras, collect, calibrate, write the files, print the tables.

    RigError when cameras do not come, or when the result fails its gate (the files are written then, too).
    """
    started_s = time.monotonic()
    with _progress(console) as progress, rig:
        sink = _collect(rig, progress)
        truth = rig.true_poses()
        description, hellos = rig.description, rig.hellos
    collected_s = time.monotonic()
    with progress_bar(console) as tell:
        result, views = sink.calibrate(description, rig.settings.calibration, tell)
        calibration = with_agents(result.calibration, hellos, rig.settings, rig.source)
        calibrated_s = time.monotonic()
        write_outputs(folder, calibration, views, result.evidence, result.poses_before, tell)
    console.print(calibration_tables(calibration, views))
    console.print(
        f"wrote calibration.json, report.html, cloud.ply, panorama.png to {folder}; capture "
        f"{collected_s - started_s:.1f} s, calibration {calibrated_s - collected_s:.1f} s, "
        f"pictures {time.monotonic() - calibrated_s:.1f} s",
        soft_wrap=True,
    )
    if truth is not None and calibration.cameras:
        _compare(calibration, truth, folder, console)
    if calibration.failures:
        raise RigError("the calibration fails its gate: " + "; ".join(calibration.failures))


def _collect(rig: Rig, progress: Progress) -> CalibrateSink:
    capture = rig.settings.capture
    waiting = progress.add_task("waiting for cameras", total=rig.settings.expected_cameras)
    rig.wait_for_cameras(capture.wait_s, lambda status: progress.update(waiting, completed=status.connected))
    connected = rig.status().connected
    progress.update(waiting, description="cameras connected", completed=connected, total=connected)
    sink = CalibrateSink(capture.frames, rig.description.camera_ids)
    collecting = progress.add_task("panoramic frames", total=capture.frames)
    until_s = time.monotonic() + capture.wait_s
    wanted = True
    while wanted and not rig.ended and time.monotonic() < until_s:
        panorama = rig.next_panorama(_POLL_S)
        if panorama is not None:
            wanted = sink.take(panorama)
            progress.update(collecting, completed=sink.complete)
    return sink


def _compare(calibration: RigCalibration, truth: Mapping[int, Pose], folder: Path, console: Console) -> None:
    write_true_poses(folder / "truth.json", truth)
    console.print(evaluation_table(evaluate(calibration, truth)))


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=console,
    )
