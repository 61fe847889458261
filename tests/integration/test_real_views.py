"""Twelve agents serve recorded views of a real Kinect over UDP; the server calibrates without any prior."""

import json
from pathlib import Path
from typing import Any

import pytest

from rig_calib.evaluation import evaluate
from rig_calib.rig_calibration import RigCalibration
from rig_calib.rig_folder_calibration import solve_folder
from rig_calib.settings import CalibrationSettings
from rig_protocol.rig_folder import read_true_poses
from support.key_for_tests import rig_key_file
from support.real_data import real_data
from support.rig_processes import LOOPBACK, folder_agents, free_port, run_program

CAMERAS = 12
VIEWS = "tum_fr1_rpy_12views"


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `rig-server --calibrate` wrote of the views that came over UDP."""
    folder, out = real_data(VIEWS), tmp_path_factory.mktemp("served")
    port = free_port()
    config = out / "rig.toml"
    config.write_text(
        f'listen = "{LOOPBACK}:{port}"\nkey_file = "{rig_key_file()}"\nexpected_cameras = {CAMERAS}\n'
        "[capture]\nframes = 1\n"
    )
    with folder_agents(folder, out, port, range(CAMERAS), fps=2.0):
        done = run_program("rig_server.cli", "--config", config, "--calibrate", "--out", out)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def test_views_without_any_prior_are_connected_and_agree_with_motion_capture(served: Path) -> None:
    calibration = RigCalibration.load(served / "calibration.json")
    assert calibration.rig_frame == "camera 0"
    assert len(calibration.cameras) == CAMERAS
    evaluation = evaluate(calibration, read_true_poses(real_data(VIEWS)))
    near, absolute = evaluation.over(evaluation.near), evaluation.absolute
    assert near is not None
    assert absolute is not None
    assert near.median.deg <= 1.2
    assert near.median.mm <= 25.0
    assert absolute.max.deg <= 4.0
    assert absolute.max.mm <= 100.0


def test_the_network_changes_nothing(served: Path) -> None:
    """Lossless transport: the same images, so the same poses and edges, to the last bit."""
    over_udp = json.loads((served / "calibration.json").read_text())
    offline = solve_folder(real_data(VIEWS), CalibrationSettings())[0].calibration.to_dict()
    assert [camera["T_rig_camera"] for camera in over_udp["cameras"]] == [
        camera["T_rig_camera"] for camera in offline["cameras"]
    ]
    assert over_udp["edges"] == offline["edges"]


def test_all_pictures_are_written_and_the_report_stands_alone(served: Path) -> None:
    assert {"calibration.json", "report.html", "cloud.ply", "panorama.png"} <= {
        path.name for path in served.iterdir()
    }
    report = (served / "report.html").read_text()
    assert "http://" not in report.replace("http://www.w3.org/", "")
    assert "https://" not in report


def test_the_result_says_where_it_came_from(served: Path) -> None:
    provenance: dict[str, Any] = json.loads((served / "calibration.json").read_text())["provenance"]
    assert provenance["source"] == "udp"
    assert provenance["agents"] == CAMERAS
    assert provenance["settings"]["capture"]["frames"] == 1
    assert provenance["versions"]["kinect-rig"]
