"""A rig whose agents stream over loopback UDP: a camera is bumped, and the server says which."""

import re
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from rig_agent.simulator.ring import rig_description
from rig_protocol.rig_folder import write_rig_folder
from rig_server import Rig
from rig_server.metrics import DriftReport
from support.box_room import calibration_of
from support.drift_rooms import DriftRoom
from support.rig_processes import folder_agents, free_port, run_program, server_settings

CAMERAS, BUMPED = 3, 1
FRAMES = range(4)  # the agents play them over and over
BUMP_DEG = 0.7
TIMEOUT_S = 100.0


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`before` and `after` the bump: two rig folders, and the calibration that one watches over."""
    folder = tmp_path_factory.mktemp("drift")
    room = DriftRoom(seed=8, people=0, cameras=CAMERAS)
    after = room.kinects | {BUMPED: room.knocked(BUMPED, BUMP_DEG, 0.0, 0)}
    for name, kinects in (("before", room.kinects), ("after", after)):
        frames = [kinect.frame(k) for kinect in kinects.values() for k in FRAMES]
        write_rig_folder(folder / name, rig_description(room.settings), frames)
    calibration_of(room.calibrated_poses()).save(folder / "calibration.json")
    return folder


def wait_for_report(rig: Rig, condition: Callable[[DriftReport], bool]) -> DriftReport:
    until_s = time.monotonic() + TIMEOUT_S
    while time.monotonic() < until_s:
        rig.next_panorama(0.5)
        report = rig.status().drift
        assert report is not None
        assert report.failure is None
        if condition(report):
            return report
    raise AssertionError(f"not within {TIMEOUT_S:.0f} s: {rig.status()}")


def moved(report: DriftReport) -> list[int]:
    return [camera.camera for camera in report.status.moved]


def test_a_bumped_camera_is_named_by_the_running_server(rig: Path, tmp_path: Path) -> None:
    port = free_port()
    watch = {"calibration": rig / "calibration.json", "every": 1}
    with ExitStack() as stack:
        server = stack.enter_context(Rig.live(server_settings(port, CAMERAS, watch=watch)))
        agents = stack.enter_context(folder_agents(rig / "before", tmp_path, port, range(CAMERAS), fps=4))
        calm = wait_for_report(
            server, lambda report: len(report.status.judged) == CAMERAS and report.status.looks > 20
        )
        assert moved(calm) == []
        agents[BUMPED].stop()
        stack.enter_context(folder_agents(rig / "after", tmp_path, port, [BUMPED], fps=4))
        alarm = wait_for_report(server, lambda report: bool(report.status.moved))
    assert moved(alarm) == [BUMPED]
    assert alarm.status.moved[0].deg == pytest.approx(BUMP_DEG, abs=0.1)


def check(rig: Path, *options: object) -> tuple[int, str, str]:
    """Exit status, standard output, standard error."""
    done = run_program("rig_calib.cli", "check", rig / "calibration.json", *options)
    assert "Traceback" not in done.stderr
    return done.returncode, done.stdout, done.stderr


def test_check_ends_with_0_while_all_are_in_place(rig: Path) -> None:
    status, printed, _ = check(rig, rig / "before")
    assert status == 0
    assert printed.count("in place") == CAMERAS


def test_check_ends_with_1_and_names_the_camera_and_what_to_do(rig: Path) -> None:
    status, printed, told = check(rig, rig / "after", "--reference", rig / "before", "--json")
    assert status == 1
    assert '"moved": [\n  1\n ]' in printed
    assert re.search(r"cam01 has moved by 0\.(69|7\d)°", told)
    assert "--calibrate --recalibrate 1" in told


def test_check_without_frames_ends_with_2(rig: Path, tmp_path: Path) -> None:
    status, _, told = check(rig, tmp_path)
    assert status == 2
    assert "nominal.json" in told
