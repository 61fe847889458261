"""The bars of the first version, on a room of another renderer and on real Kinect frames."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig_calib.calibration import CalibrationResult
from rig_calib.cli import app
from rig_calib.evaluation import PoseError, evaluate
from rig_calib.rig_folder_calibration import solve_folder
from rig_calib.settings import CalibrationSettings
from rig_protocol.poses import inverse
from rig_protocol.rig_folder import read_true_poses
from support.real_data import real_data

SETTINGS = CalibrationSettings()
MOTION_CAPTURE_LIMIT_DEG, MOTION_CAPTURE_LIMIT_MM = 4.0, 100.0


@pytest.fixture(scope="module")
def office() -> tuple[Path, CalibrationResult]:
    folder = real_data("tum_fr1_rpy_12views")
    return folder, solve_folder(folder, SETTINGS)[0]


def test_a_rendered_room_with_one_frame_meets_its_bar() -> None:
    folder = real_data("rendered_room")
    calibration = solve_folder(folder, SETTINGS, frames=1)[0].calibration
    errors = evaluate(calibration, read_true_poses(folder))
    neighbours = errors.over(errors.neighbours)
    assert neighbours is not None
    assert neighbours.count == 12
    assert neighbours.mean.deg <= 0.25
    assert neighbours.mean.mm <= 8.0
    assert calibration.failures == ()


def test_real_views_without_any_prior_meet_their_bar(office: tuple[Path, CalibrationResult]) -> None:
    folder, result = office
    errors = evaluate(result.calibration, read_true_poses(folder))
    near, absolute = errors.over(errors.near), errors.absolute
    assert len(result.calibration.cameras) == 12
    assert near is not None
    assert absolute is not None
    assert near.median.deg <= 1.2
    assert near.median.mm <= 25.0
    assert absolute.max.deg <= MOTION_CAPTURE_LIMIT_DEG
    assert absolute.max.mm <= MOTION_CAPTURE_LIMIT_MM
    assert result.calibration.failures == ()


def test_plausible_false_pairs_are_not_believed(office: tuple[Path, CalibrationResult]) -> None:
    """What a used edge says alone is true: the false poses that some pairs' keypoints agree on are gone."""
    folder, result = office
    truth = read_true_poses(folder)
    errors = evaluate(result.calibration, truth)
    assert max(errors.pairs[pair].deg for pair in errors.used) < 5.0
    used = [edge for edge in result.calibration.edges if edge.used]
    alone = [PoseError.between(edge.T_i_j, inverse(truth[edge.i]) @ truth[edge.j]) for edge in used]
    assert max(error.deg for error in alone) < 5.0


def test_solving_real_views_again_gives_bit_identical_results(
    office: tuple[Path, CalibrationResult],
) -> None:
    folder, first = office
    second = solve_folder(folder, SETTINGS)[0]
    for key in ("cameras", "edges"):
        assert first.calibration.to_dict()[key] == second.calibration.to_dict()[key]


def test_the_command_line_writes_all_files_and_evaluates_them(tmp_path: Path) -> None:
    """Four cameras that look nearly the same way, for speed."""
    source = real_data("tum_fr1_rpy_12views")
    folder, out = tmp_path / "rig", tmp_path / "out"
    folder.mkdir()
    nominal = json.loads((source / "nominal.json").read_text())
    nominal["cameras"] = [camera for camera in nominal["cameras"] if camera["id"] in (0, 8, 9, 11)]
    (folder / "nominal.json").write_text(json.dumps(nominal))
    for camera in nominal["cameras"]:
        (folder / camera["name"]).symlink_to(source / camera["name"])
    run = CliRunner().invoke(app, ["solve", str(folder), "--out", str(out), "--method", "paper", "--json"])
    assert run.exit_code == 0, run.output
    assert json.loads(run.stdout)["method"] == "paper"
    for name in ("calibration.json", "report.html", "cloud.ply", "panorama.png"):
        assert (out / name).stat().st_size > 0
    told = json.loads(
        CliRunner().invoke(app, ["evaluate", str(out / "calibration.json"), str(source), "--json"]).stdout
    )
    assert told["near"]["median_deg"] < 2.5
    assert told["missing"] == [1, 2, 3, 4, 5, 6, 7, 10]
