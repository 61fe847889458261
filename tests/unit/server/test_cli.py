"""The command line of rig-server: what it writes, what it refuses, how it ends."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from rig_server.config import RigSettings, load_rig_settings


def rig_server(*words: str, cwd: Path) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "rig_server.cli", *words]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=60, check=False)


def test_init_writes_a_file_that_changes_nothing_and_never_overwrites_one(tmp_path: Path) -> None:
    first = rig_server("init", cwd=tmp_path)
    assert first.returncode == 0, first.stderr
    assert load_rig_settings(tmp_path / "rig.toml") == RigSettings()
    again = rig_server("init", cwd=tmp_path)
    assert again.returncode == 2
    assert "rig.toml exists" in again.stderr


def test_help_teaches_with_examples(tmp_path: Path) -> None:
    shown = rig_server("--help", cwd=tmp_path)
    assert shown.returncode == 0
    for word in ("--calibrate", "--simulate", "--out", "init", "Examples", "Exit status"):
        assert word in shown.stdout


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--frames", "3"], "--frames needs --calibrate"),
        (["--seed", "3"], "--seed needs --simulate"),
        (["--simulate", "2", "--listen", ":0"], "--listen has no effect with --simulate"),
        (["--calibrate", "--method", "magic"], "calibration.method"),
        (["--config", "absent.toml"], "absent.toml cannot be read"),
        (["--listen", "192.0.2.1:0"], "no interface of this machine has address 192.0.2.1"),
        (["--simulate", "0"], "--simulate"),
    ],
)
def test_wrong_usage_ends_with_status_2_and_says_why(tmp_path: Path, words: list[str], told: str) -> None:
    refused = rig_server(*words, cwd=tmp_path)
    assert refused.returncode == 2
    assert told in refused.stderr


def test_a_port_in_use_ends_with_status_1_and_says_what_to_do(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        refused = rig_server("--listen", f"127.0.0.1:{port}", cwd=tmp_path)
    assert refused.returncode == 1
    assert f"UDP port {port} is in use" in refused.stderr


def test_cameras_that_do_not_come_end_the_calibration_with_status_1_and_their_names(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(
        "listen = '127.0.0.1:0'\n[capture]\nwait_s = 0.5\n[[cameras]]\nid = 0\nname = 'door'\n[[cameras]]\nid = 1\n"
    )
    ended = rig_server("--calibrate", cwd=tmp_path)
    assert ended.returncode == 1
    assert "2 of 2 cameras have not come: door, cam01" in ended.stderr


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_running_server_ends_with_status_0_when_told_to_stop(tmp_path: Path, number: signal.Signals) -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "rig_server.cli", "--listen", "127.0.0.1:0"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    ) as server:
        assert server.stdout is not None
        assert "0/0 cameras" in server.stdout.readline()
        server.send_signal(number)
        assert server.wait(timeout=20) == 0
