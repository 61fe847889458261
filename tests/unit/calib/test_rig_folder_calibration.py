"""Recalibration of a recorded folder, from files to files; keypoints are synthetic."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig_calib import calibration as pipeline
from rig_calib.calibration import calibrate
from rig_calib.cli import main
from rig_calib.observed_camera import ObservedCamera
from rig_calib.rig_folder_calibration import solve_folder
from rig_calib.settings import CalibrationSettings
from rig_calib.view import CameraView
from rig_protocol.poses import se3_exp
from rig_protocol.rig_folder import CameraEntry, RigDescription
from support.synthetic_rig import IMAGE, MODEL, NO_DEPTH, SyntheticRig


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> SyntheticRig:
    rig = SyntheticRig(cameras=3)

    def observe(view: CameraView, *_: object) -> ObservedCamera:
        return replace(rig.observe(view.camera_id, 0.25, 0.3), view=view)

    monkeypatch.setattr(pipeline, "observe", observe)
    return rig


def write_folder(folder: Path, rig: SyntheticRig) -> Path:
    entries = tuple(
        CameraEntry(c, f"cam{c:02d}", MODEL, rig.drawing.T_rig_camera(c)) for c in range(rig.cameras)
    )
    for entry in entries:
        (folder / entry.name).mkdir(parents=True)
        cv2.imwrite(str(folder / entry.name / "color_000.png"), np.dstack([IMAGE] * 3))
        cv2.imwrite(str(folder / entry.name / "raw_000.png"), NO_DEPTH)
    (folder / "nominal.json").write_text(json.dumps(RigDescription(entries, rig.drawing).to_dict()))
    return folder


def test_what_accelerometers_felt_comes_from_the_folder_to_the_calibration(
    rig: SyntheticRig, tmp_path: Path
) -> None:
    folder = write_folder(tmp_path / "rig", rig)
    values = json.loads((folder / "nominal.json").read_text())
    for c in (0, 2):
        down = rig.truth[c][:3, :3].T @ np.array([0.0, 0.0, -1.0])
        values["cameras"][c]["gravity"] = {"down": down.tolist(), "sigma_deg": 1.0}
    (folder / "nominal.json").write_text(json.dumps(values))
    result, views = solve_folder(folder, CalibrationSettings())
    assert [None if view.gravity is None else view.gravity_sigma_deg for view in views] == [1.0, None, 1.0]
    provenance = result.calibration.provenance
    assert provenance["gravity_cameras"] == [0, 2]
    assert provenance["source"] == "folder"


def run(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    monkeypatch.setattr(sys, "argv", ["rig-calib", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def test_a_camera_of_a_folder_is_found_anew_and_the_calibration_before_is_kept(
    rig: SyntheticRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, out = write_folder(tmp_path / "rig", rig), tmp_path / "out"
    out.mkdir()
    known = calibrate(rig.views(), rig.drawing, CalibrationSettings()).calibration
    known.save(out / "calibration.json")
    rig.truth[2] = rig.truth[2] @ se3_exp(np.array([0.02, 0.02, 0.0, 0.01, 0.0, 0.0]))
    assert run(monkeypatch, "solve", folder, "--recalibrate", "cam02", "--out", out) == 0
    before, after = (
        json.loads((out / name).read_text()) for name in ("calibration-before.json", "calibration.json")
    )
    assert before == known.to_dict()
    assert after["cameras"][:2] == before["cameras"][:2]
    (record,) = after["provenance"]["recalibrated"]
    assert (record["camera"], record["source"], record["frames"]) == (2, "folder", 1)
    assert record["moved"]["deg"] > 1.0
    assert (out / "report.html").exists()
