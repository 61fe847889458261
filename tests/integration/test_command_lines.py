"""The programs as a person meets them: mistakes, cameras that do not come, the whole job."""

import json
from pathlib import Path

import pytest

from rig_calib.evaluation import evaluate
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.rig_folder import read_true_poses
from support.rig_processes import (
    LOOPBACK,
    folder_agents,
    free_port,
    rig_key_file,
    run_program,
    write_small_rig,
)


def test_a_camera_that_never_comes_is_named(tmp_path: Path) -> None:
    write_small_rig(tmp_path / "rig", cameras=2)
    port = free_port()
    config = tmp_path / "rig.toml"
    config.write_text(
        f'listen = "{LOOPBACK}:{port}"\nkey_file = "{rig_key_file()}"\n[capture]\nwait_s = 8.0\n'
        '[[cameras]]\nid = 0\n[[cameras]]\nid = 1\nname = "window"\n'
    )
    with folder_agents(tmp_path / "rig", tmp_path, port, [0]):
        done = run_program("rig_server.cli", "--config", config, "--calibrate", "--out", tmp_path / "out")
    assert done.returncode == 1, done.stderr
    assert "window" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("module", "options", "told"),
    [
        ("rig_server.cli", ["--frames", 3], "--calibrate"),
        ("rig_server.cli", ["--config", "absent.toml"], "absent.toml"),
        ("rig_server.cli", ["--listen", "nowhere:port"], "nowhere:port"),
        ("rig_agent.cli", ["--source", "webcam"], "webcam"),
        ("rig_agent.cli", ["--source", "folder", "--path", "absent", "--camera", 0, "--insecure"], "absent"),
        ("rig_agent.cli", ["--source", "folder", "--key-file", "absent.key"], "absent.key"),
        ("rig_server.cli", ["--calibrate", "--insecure", "--config", "key.toml"], "drop one"),
        ("rig_server.cli", ["keygen", "--path", "absent/rig.key"], "absent/rig.key"),
        ("rig_agent.cli", ["--source", "folder", "--fps", -1], "fps"),
        ("rig_calib.cli", ["solve", "absent", "--out", "out"], "absent"),
        ("rig_calib.cli", ["solve", ".", "--recalibrate", "cam01", "--out", "out"], "out/calibration.json"),
        ("rig_calib.cli", ["solve", ".", "--calibration", "x.json", "--out", "out"], "--recalibrate"),
        ("rig_calib.cli", ["evaluate", "absent.json", "absent.json"], "absent.json"),
        ("rig_calib.cli", ["export", "c.json", "--format", "tum", "--out", "o"], "a recording FILE.mcap"),
        ("rig_calib.cli", ["export", "t.mcap", "--format", "ros2", "--out", "o"], "a calibration.json"),
        (
            "rig_calib.cli",
            ["export", "c.json", "--format", "ros2", "--out", "o", "--workers", 2],
            "--workers",
        ),
        ("rig_calib.cli", ["export", "t.mcap", "--format", "tum", "--out", "o", "--rig", "r"], "--rig"),
    ],
)
def test_a_wrong_option_ends_with_2_and_says_which(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, options: list[object], told: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("key.toml").write_text('key_file = "rig.key"')
    done = run_program(module, *options)
    assert done.returncode == 2, done.stderr
    assert told in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("module", ["rig_server.cli", "rig_agent.cli"])
def test_a_misspelt_key_is_answered_with_the_nearest_one(tmp_path: Path, module: str) -> None:
    config = tmp_path / "settings.toml"
    config.write_text('log_levle = "INFO"\n')
    done = run_program(module, "--config", config)
    assert done.returncode == 2
    assert "did you mean `log_level`" in done.stderr


@pytest.mark.parametrize("module", ["rig_server.cli", "rig_agent.cli", "rig_calib.cli"])
def test_help_teaches_by_examples(module: str) -> None:
    done = run_program(module, "--help")
    assert done.returncode == 0
    assert "xample" in done.stdout


def test_a_target_ends_a_capture_early_and_a_camera_is_found_anew_with_the_others_untouched(
    tmp_path: Path,
) -> None:
    """Three simulated cameras over loopback; the second run's target is out of reach."""
    options = ["--calibrate", "--simulate", 3, "--out", tmp_path]
    done = run_program("rig_server.cli", *options, "--frames", 20, "--target-mm", 60, "--target-deg", 3)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the target is met on 1 set" in done.stdout
    before = json.loads((tmp_path / "calibration.json").read_text())
    assert before["frames_used"] == 1
    again = [*options, "--frames", 1, "--recalibrate", "cam02", "--target-mm", 0.01]
    done = run_program("rig_server.cli", *again)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "misses its target: cam01–cam02 limits" in done.stderr
    assert "Traceback" not in done.stderr
    after = json.loads((tmp_path / "calibration.json").read_text())
    assert after["cameras"][:2] == before["cameras"][:2]
    assert after["cameras"][2] != before["cameras"][2]
    assert [one["name"] for one in after["provenance"]["recalibrated"]] == ["cam02"]
    assert json.loads((tmp_path / "calibration-before.json").read_text()) == before


def test_simulated_rig_is_calibrated_fused_and_compared_with_the_truth(tmp_path: Path) -> None:
    """The demo's job on the reference scene, and its bar."""
    done = run_program(
        "rig_server.cli", "--calibrate", "--simulate", 12, "--frames", 5, "--out", tmp_path, timeout_s=170
    )
    assert done.returncode == 0, done.stdout + done.stderr
    for name in ("calibration.json", "report.html", "cloud.ply", "panorama.png", "truth.json"):
        assert (tmp_path / name).stat().st_size > 0
    calibration = json.loads((tmp_path / "calibration.json").read_text())
    assert calibration["rig_frame"] == "ring"
    assert len(calibration["cameras"]) == 12
    assert calibration["provenance"]["source"] == "udp"
    assert calibration["provenance"]["agents"] == 12
    assert calibration["provenance"]["gravity_cameras"] == list(range(12))
    errors = evaluate(RigCalibration.load(tmp_path / "calibration.json"), read_true_poses(tmp_path))
    neighbours = errors.over(errors.neighbours)
    assert neighbours is not None
    assert neighbours.count == 12
    assert neighbours.mean.deg <= 0.15
    assert neighbours.mean.mm <= 4.0
