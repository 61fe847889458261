"""`rig-calib pattern` and `rig-calib export` as a person meets them."""

import json
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig_calib.cli import main
from rig_calib.exports import colmap, kalibr, nerfstudio, ros2
from rig_calib.exports.formats import FORMATS
from rig_calib.rig_calibration import CalibratedCamera, CalibratedEdge, RigCalibration
from rig_protocol.camera import CameraModel, Intrinsics
from rig_protocol.rig_folder import CameraEntry, RigDescription, RingDrawing

Program = Callable[..., int]

MODEL = CameraModel(color=Intrinsics(527.0, 526.0, 321.0, 242.0), source="file")


@pytest.fixture
def rig_calib(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Program]:
    """Run the program in this process, in a folder with a calibration and a rig folder; its exit status."""
    monkeypatch.chdir(tmp_path)
    make_calibration().save(Path("calibration.json"))
    make_rig_folder(Path("rig"))
    handler = signal.getsignal(signal.SIGTERM)

    def run(*words: str) -> int:
        monkeypatch.setattr(sys, "argv", ["rig-calib", *words])
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0)

    yield run
    signal.signal(signal.SIGTERM, handler)


def make_calibration(failures: tuple[str, ...] = ()) -> RigCalibration:
    cameras = tuple(CalibratedCamera(n, f"cam{n:02d}", RingDrawing().T_rig_camera(n)) for n in range(3))
    edges = (
        CalibratedEdge(0, 1, 50, 40, 1.0, np.eye(4), True),
        CalibratedEdge(1, 2, 4, 3, 1.0, np.eye(4), False),
    )
    return RigCalibration("joint", "ring", cameras, edges, None, {"total": 1.0}, 1, failures=failures)


def make_rig_folder(folder: Path, cameras: int = 3) -> None:
    entries = tuple(CameraEntry(n, f"cam{n:02d}", MODEL) for n in range(cameras))
    for entry in entries:
        (folder / entry.name).mkdir(parents=True)
        for k in (4, 7):
            cv2.imwrite(str(folder / entry.name / f"color_{k:03d}.png"), np.zeros((4, 4), np.uint8))
    (folder / "nominal.json").write_text(json.dumps(RigDescription(entries).to_dict()))


@pytest.mark.parametrize("form", FORMATS)
def test_every_format_is_written_into_a_folder_and_named(
    rig_calib: Program, form: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rig_calib("export", "calibration.json", "--format", form, "--out", "made", "--rig", "rig") == 0
    named = capsys.readouterr().out.split()
    assert sorted(named) == sorted(str(path) for path in Path("made").rglob("*") if path.is_file())
    assert named


def test_a_format_of_one_file_goes_where_the_user_says(rig_calib: Program) -> None:
    words = ["export", "calibration.json", "--format", "kalibr", "--rig", "rig"]
    assert rig_calib(*words, "--out", "deep/chain.yml") == 0
    chain = kalibr.read_camchain(Path("deep/chain.yml").read_text())
    assert [camera.color for camera in chain.cameras] == [MODEL.color] * 3
    assert chain.overlaps == ((0, 1),), "an edge that was dropped is no overlap to rely on"


def test_ros_needs_no_intrinsics(rig_calib: Program) -> None:
    assert rig_calib("export", "calibration.json", "--format", "ros2", "--out", "rig.launch.py") == 0
    assert len(ros2.read_launch(Path("rig.launch.py").read_text()).cameras) == 3


def test_image_names_lead_from_the_file_to_the_images(rig_calib: Program) -> None:
    words = ["export", "calibration.json", "--format", "nerfstudio", "--rig", "rig", "--frames", "2"]
    assert rig_calib(*words, "--out", "a/b") == 0
    rig = nerfstudio.read_transforms(Path("a/b/transforms.json").read_text())
    paths = [Path("a/b") / name for camera in rig.cameras for name in camera.images.values()]
    assert len(paths) == 6
    assert all(path.is_file() for path in paths)


def test_colmap_lists_as_many_frames_as_asked_for(rig_calib: Program) -> None:
    words = ["export", "calibration.json", "--format", "colmap", "--rig", "rig", "--out", "c"]
    for frames, listed in ((1, 3), (2, 6), (9, 6)):
        assert rig_calib(*words, "--frames", str(frames)) == 0
        assert len(Path("c", colmap.IMAGE_LIST).read_text().splitlines()) == listed


def test_a_rig_toml_gives_the_intrinsics_that_its_cameras_name(
    rig_calib: Program, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("settings").mkdir()
    Path("settings/unit.json").write_text(json.dumps(MODEL.to_dict()))
    Path("settings/rig.toml").write_text(
        'listen = "0.0.0.0:4012"\n'
        + "".join(f'[[cameras]]\nid = {n}\nintrinsics = "unit.json"\n' for n in (0, 1))
    )
    words = ["export", "calibration.json", "--format", "kalibr", "--out", "chain.yaml"]
    assert rig_calib(*words, "--rig", "settings/rig.toml") == 2
    said = capsys.readouterr().err
    assert "cam02" in said
    assert "cam01" not in said


def test_a_doubtful_calibration_is_exported_with_a_word(
    rig_calib: Program, capsys: pytest.CaptureFixture[str]
) -> None:
    make_calibration(failures=("camera cam01 is not connected",)).save(Path("doubtful.json"))
    make_rig_folder(Path("larger"), cameras=4)
    assert rig_calib("export", "doubtful.json", "--format", "opencv", "--out", "o", "--rig", "larger") == 0
    said = capsys.readouterr().out
    assert "cam01 is not connected" in said
    assert "left out: cameras 3" in said


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["calibration.json", "--format", "ros1", "--out", "x"], "ros2"),
        (["calibration.json", "--format", "ros1", "--out", "x"], "foxglove"),
        (["absent.json", "--format", "ros2", "--out", "x"], "absent.json"),
        (["calibration.json", "--format", "colmap", "--out", "x"], "--rig"),
        (["calibration.json", "--format", "colmap", "--out", "x", "--rig", "absent"], "absent"),
        (["calibration.json", "--format", "colmap", "--out", "x", "--rig", "absent.toml"], "absent.toml"),
        (["calibration.json", "--format", "ros2", "--out", "calibration.json/x"], "cannot write"),
    ],
)
def test_a_wrong_export_ends_with_2_and_says_why(
    rig_calib: Program, words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rig_calib("export", *words) == 2
    assert told in capsys.readouterr().err


@pytest.mark.parametrize(
    "toml", ["[[cameras]]\nintrinsics = 'a.json'", "cameras = 3", "= 3", "cameras = ['a']"]
)
def test_a_malformed_rig_toml_is_refused_in_words(
    rig_calib: Program, toml: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("rig.toml").write_text(toml)
    words = ["export", "calibration.json", "--format", "kalibr", "--out", "x", "--rig", "rig.toml"]
    assert rig_calib(*words) == 2
    assert "rig.toml" in capsys.readouterr().err


def test_patterns_are_made_and_the_next_step_is_told(
    rig_calib: Program, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rig_calib("pattern", "--out", "p", "--paper", "a4", "--patterns", "2", "--seed", "9") == 0
    said = capsys.readouterr().out
    assert "2 different patterns" in said
    assert "scale bar" in said
    assert json.loads(Path("p/patterns.json").read_text())["seed"] == 9
    assert Path("p/patterns.pdf").read_bytes().startswith(b"%PDF")


def test_what_cannot_be_printed_ends_with_2(rig_calib: Program, capsys: pytest.CaptureFixture[str]) -> None:
    assert rig_calib("pattern", "--out", "p", "--paper", "letter") == 2
    assert "A3" in capsys.readouterr().err
