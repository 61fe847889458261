"""The command line of rig-server: what it writes, what it refuses, how it ends."""

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rig_protocol.key_file import read_key
from rig_server.cli import main
from rig_server.config import RigSettings, load_rig_settings
from support.takes import record_take

Program = Callable[..., int]


@pytest.fixture
def rig_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Program]:
    """Run the program in this process, in an empty folder and without a key; its exit status."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("rig_protocol.key_file.KEY_PLACES", (Path("rig.key"),))
    (tmp_path / "with-key.toml").write_text('key_file = "rig.key"')
    handler = signal.getsignal(signal.SIGTERM)

    def run(*words: str) -> int:
        monkeypatch.setattr(sys, "argv", ["rig-server", *words])
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0)

    yield run
    signal.signal(signal.SIGTERM, handler)


def test_init_writes_a_file_that_changes_nothing_and_overwrites_only_by_force(
    rig_server: Program, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rig_server("init") == 0
    assert load_rig_settings(tmp_path / "rig.toml") == RigSettings()
    (tmp_path / "rig.toml").write_text("expected_cameras = 3\n")
    assert rig_server("init") == 2
    assert "rig.toml exists" in capsys.readouterr().err
    assert load_rig_settings(tmp_path / "rig.toml").expected_cameras == 3
    assert rig_server("init", "--force") == 0
    assert load_rig_settings(tmp_path / "rig.toml") == RigSettings()


def test_keygen_makes_a_key_that_only_its_owner_reads_and_replaces_one_only_by_force(
    rig_server: Program, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rig_server("keygen") == 0
    assert "wrote rig.key (mode 0600)" in capsys.readouterr().out
    first = read_key(tmp_path / "rig.key")
    assert not first.is_public
    assert rig_server("keygen") == 2
    assert "rig.key exists" in capsys.readouterr().err
    assert read_key(tmp_path / "rig.key") == first
    assert rig_server("keygen", "--force") == 0
    assert read_key(tmp_path / "rig.key") != first
    assert rig_server("keygen", "--path", "other.key") == 0
    assert read_key(tmp_path / "other.key") != read_key(tmp_path / "rig.key")
    assert "other.key" in capsys.readouterr().out


def test_the_key_itself_is_never_printed(
    rig_server: Program, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig_server("keygen")
    shown = capsys.readouterr()
    assert (tmp_path / "rig.key").read_text().split()[1] not in shown.out + shown.err


def test_an_insecure_server_says_so_loudly(
    rig_server: Program, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    rig_server("--listen", "192.0.2.1:0", "--insecure")
    assert "INSECURE: anybody on this network" in caplog.text + capsys.readouterr().err


def test_help_teaches_with_examples(rig_server: Program, capsys: pytest.CaptureFixture[str]) -> None:
    assert rig_server("--help") == 0
    shown = capsys.readouterr().out
    for word in ("--calibrate", "--simulate", "--out", "init", "budget", "Examples", "Exit status"):
        assert word in shown


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--frames", "3"], "--frames needs --calibrate"),
        (["--target-mm", "3"], "--target-mm needs --calibrate"),
        (["--coach"], "--coach needs --calibrate"),
        (["--recalibrate", "cam03"], "--recalibrate needs --calibrate"),
        (["--calibrate", "--insecure", "--calibration", "x.json"], "--calibration needs --recalibrate"),
        (["--calibrate", "--insecure", "--recalibrate", "cam03"], "there is no calibration/calibration.json"),
        (["--calibrate", "--insecure", "--target-mm", "0"], "capture.target_mm"),
        (["--calibrate", "--simulate", "2", "--method", "paper", "--target-deg", "1"], "paper"),
        (["--seed", "3"], "--seed needs --simulate"),
        (["--simulate", "2", "--listen", ":0"], "--listen has no effect with --simulate"),
        (["--calibrate", "--method", "magic"], "calibration.method"),
        (["--config", "absent.toml"], "absent.toml cannot be read"),
        (["--listen", "192.0.2.1:0", "--insecure"], "no interface of this machine has address 192.0.2.1"),
        (["--simulate", "0"], "--simulate"),
        (["--calibrate", "--out", "/proc/no"], "cannot write to /proc/no"),
        ([], "run `rig-server keygen` on the PC"),
        (["--insecure", "--config", "with-key.toml"], "drop one"),
    ],
)
def test_wrong_usage_ends_with_status_2_and_says_why(
    rig_server: Program, capsys: pytest.CaptureFixture[str], words: list[str], told: str
) -> None:
    assert rig_server(*words) == 2
    assert told in capsys.readouterr().err


def test_a_port_in_use_ends_with_status_1_and_says_what_to_do(
    rig_server: Program, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        assert rig_server("--listen", f"127.0.0.1:{port}", "--insecure") == 1
    assert f"UDP port {port} is in use" in capsys.readouterr().err


def test_cameras_that_do_not_come_end_the_calibration_with_status_1_and_their_names(
    rig_server: Program, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cameras = "[[cameras]]\nid = 0\nname = 'door'\n[[cameras]]\nid = 1\n"
    (tmp_path / "rig.toml").write_text(f"listen = '127.0.0.1:0'\n[capture]\nwait_s = 0.5\n{cameras}")
    assert rig_server("--calibrate", "--insecure") == 1
    assert "2 of 2 cameras have not come: door, cam01" in capsys.readouterr().err


def test_budget_goes_by_the_cameras_of_rig_toml_and_says_what_it_chose(
    rig_server: Program, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rig.toml").write_text("expected_cameras = 8\n[link]\nmtu = 9000\n")
    assert rig_server("budget", "--json", "--link-mbit", "300") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["cameras"], told["link"]["mtu"], told["link"]["speed_mbit"]) == (8, 9000, 300)
    assert [one["chosen"] for one in told["configurations"]] == [False, False, False, True]
    assert told["chosen_fps"] == 30.0
    assert told["pacing"]["backlog_bytes"] <= 128 * 1024
    assert rig_server("budget") == 0
    assert "8 cameras at 30 fps" in capsys.readouterr().out


def test_budget_ends_with_status_1_when_nothing_fits_and_2_for_a_link_that_cannot_be(
    rig_server: Program, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rig_server("budget", "--link-mbit", "2") == 1
    assert "use fewer cameras" in capsys.readouterr().out.replace("\n", " ")
    assert rig_server("budget", "--link-mbit", "0") == 2
    assert "link.speed_mbit" in capsys.readouterr().err


def test_a_running_server_ends_with_status_0_when_told_to_stop(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "rig_server.cli", "--listen", "127.0.0.1:0", "--insecure"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    ) as server:
        assert server.stdout is not None
        assert "0/0 cameras" in server.stdout.readline()
        server.terminate()
        assert server.wait(timeout=20) == 0


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--seek", "3"), "--seek needs --replay FILE"),
        (("--loop",), "--loop needs --replay FILE"),
        (("--replay", "a.mcap", "--simulate", "2"), "--simulate has no effect with --replay"),
        (("--replay", "a.mcap", "--replay-speed", "fast"), "write live, max, or a number"),
        (("--replay", "a.mcap", "--replay-speed", "nan"), "write live, max, or a number"),
        (
            ("--replay", "a.mcap", "--calibrate", "--projector-groups", "2"),
            "projector groups need a live rig",
        ),
        (("--replay", "a.mcap"), "a.mcap cannot be read"),
        (("recover", "a.mcap"), "a.mcap cannot be read"),
    ],
)
def test_options_of_replay_that_make_no_sense_end_with_status_2(
    rig_server: Program, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], told: str
) -> None:
    assert rig_server(*words) == 2
    assert told in capsys.readouterr().err


def test_a_torn_take_is_recovered_and_played_by_the_program(
    rig_server: Program, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record_take(tmp_path / "whole.mcap", sets=5)
    (tmp_path / "take.mcap").write_bytes((tmp_path / "whole.mcap").read_bytes()[:-100])
    assert rig_server("recover", "take.mcap") == 0
    assert "mended take.mcap; what was there is now take.mcap.torn" in capsys.readouterr().out
    assert rig_server("recover", "take.mcap") == 0
    assert "take.mcap is sound" in capsys.readouterr().out
    assert rig_server("--replay", "take.mcap", "--replay-speed", "max") == 0
    assert "recording take.mcap has ended: 5 complete, 0 partial sets" in capsys.readouterr().out


@pytest.mark.parametrize("address", ["nonsense", ":8080", "localhost:port", "127.0.0.1:99999"])
def test_a_consoles_address_that_makes_no_sense_is_refused_at_once(
    rig_server: Program, capsys: pytest.CaptureFixture[str], address: str
) -> None:
    assert rig_server("--insecure", "--console", address) == 2
    told = capsys.readouterr().err
    assert "console" in told
    assert address in told


def test_a_console_whose_port_is_taken_says_what_to_do(
    rig_server: Program, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert rig_server("--insecure", "--listen", "127.0.0.1:0", "--console", port) == 1
    assert f"TCP port {port} is in use" in capsys.readouterr().err
