"""`rig-calib export` to clouds, and `rig-calib fuse` of a recording that carries its calibration."""

import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rig_calib.cli import main
from support.box_takes import box_calibration, box_description, box_panorama, write_take

Program = Callable[..., int]


@pytest.fixture
def rig_calib(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Program]:
    """Run the program in this process, in a folder with two takes: hall.mcap, and bare.mcap uncalibrated."""
    monkeypatch.chdir(tmp_path)
    panoramas = [box_panorama(k) for k in range(4)]
    write_take(Path("hall.mcap"), box_description(), panoramas, box_calibration())
    write_take(Path("bare.mcap"), box_description(), panoramas[:1])
    handler = signal.getsignal(signal.SIGTERM)

    def run(*words: str) -> int:
        monkeypatch.setattr(sys, "argv", ["rig-calib", *words])
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0)

    yield run
    signal.signal(signal.SIGTERM, handler)


def test_chosen_frames_become_a_folder_of_clouds(
    rig_calib: Program, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--out", "clouds", "--first", "1", "--every", "2", "--workers", "1"]
    assert rig_calib("export", "hall.mcap", "--format", "ply", *words) == 0
    assert sorted(path.name for path in Path("clouds").iterdir()) == ["cloud_000001.ply", "cloud_000003.ply"]
    assert "clouds" in capsys.readouterr().out


def test_several_frames_for_one_file_are_refused_before_the_work(
    rig_calib: Program, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--out", "hall.las", "--workers", "1"]
    assert rig_calib("export", "hall.mcap", "--format", "las", *words) == 2
    assert "choose one frame with --frames 1" in capsys.readouterr().err.replace("\n", " ")
    assert rig_calib("export", "hall.mcap", "--format", "las", *words, "--frames", "1") == 0
    assert Path("hall.las").is_file()


def test_a_recording_is_fused_with_the_calibration_that_it_carries(rig_calib: Program) -> None:
    assert rig_calib("fuse", "hall.mcap", "--frames", "1", "--out", "fused") == 0
    assert Path("fused/cloud.ply").is_file()


def test_fusing_without_any_calibration_says_what_to_do(
    rig_calib: Program, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rig_calib("fuse", "bare.mcap", "--out", "fused") == 2
    assert "carries no calibration: name it with --calibration" in capsys.readouterr().err.replace("\n", " ")
    assert not Path("fused").exists()
