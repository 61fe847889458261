"""The examination as a whole: nothing holds it up, nothing breaks it, the report can be read and parsed."""

import io
import json
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import usb.util
from rich.console import Console
from typer.testing import CliRunner

from rig_agent import cli
from rig_agent.config import AgentSettings
from rig_agent.doctor import examination, report
from rig_agent.doctor.examination import examine
from rig_agent.doctor.finding import Check, Finding, Status, failed, ok, skipped, warning
from rig_agent.doctor.frames import frames
from rig_agent.sources.base import SourceLost
from rig_protocol.errors import ConfigurationError
from rig_protocol.troubleshooting import Topic
from support.loopback_server import LoopbackServer
from support.pi_tree import PiTree

ROOT = Path(__file__).resolve().parents[4]


@pytest.fixture(autouse=True)
def _no_real_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(usb.util, "dispose_resources", lambda _device: None)
    monkeypatch.setattr(cli, "_on_signals", lambda _action: None)  # the signals are pytest's


@pytest.fixture
def pi(tmp_path: Path) -> PiTree:
    return PiTree(tmp_path / "root")


@pytest.fixture
def rig() -> Iterator[LoopbackServer]:
    with LoopbackServer() as rig:
        yield rig


def settings_for(rig: LoopbackServer, **more: Any) -> AgentSettings:
    return AgentSettings(server=f"{rig.address[0]}:{rig.address[1]}", camera=0, insecure=True, **more)


def no_kinect(*_: Any) -> Any:
    raise SourceLost("no Kinect", Topic.NO_KINECT)


def test_a_simulated_camera_is_examined_without_usb(pi: PiTree, rig: LoopbackServer) -> None:
    settings = settings_for(rig, source="synthetic")
    found = list(examine(pi.machine(), settings))
    assert report.passed(found), found
    assert not any(finding.check.startswith("usb.") for finding in found)
    assert {Check.FRAMES, Check.SERVER} <= {finding.check for finding in found if finding.status == Status.OK}


def test_without_a_kinect_only_hardware_fails(pi: PiTree, rig: LoopbackServer) -> None:
    """What an automated deployment must be able to tell."""
    machine = pi.machine(usb_devices=list, open_source=no_kinect)
    found = list(examine(machine, settings_for(rig)))
    told = json.loads(report.to_json([one for one in found if one.check != Check.LIBUSB], "freenect"))
    assert (told["passed"], told["passed_but_for_hardware"]) == (False, True)
    told = json.loads(report.to_json(found, "freenect"))
    assert (told["passed"], told["passed_but_for_hardware"]) == (False, False)


def test_a_bus_that_hangs_and_a_check_that_breaks_hold_up_nothing(
    pi: PiTree, rig: LoopbackServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(examination, "_USB_LIMIT_S", 0.05)
    released = threading.Event()

    def hang() -> Any:
        released.wait()
        return []

    def broken(_folder: Path) -> int:
        raise ZeroDivisionError

    machine = pi.machine(usb_devices=hang, free_bytes=broken, open_source=no_kinect)
    found = {finding.check: finding for finding in examine(machine, settings_for(rig))}
    released.set()
    assert (found[Check.KINECT].status, found[Check.KINECT].topic) == (Status.FAILED, Topic.HANGING_KINECT)
    assert (found[Check.SPACE].status, "broke" in found[Check.SPACE].text) == (Status.FAILED, True)
    assert found[Check.SERVER].status == Status.OK


@pytest.mark.parametrize(
    ("error", "status", "hardware"),
    [
        (SourceLost("no images", Topic.NO_FRAMES), Status.FAILED, True),
        (SourceLost("in use", Topic.KINECT_IN_USE), Status.FAILED, False),
        (SourceLost("nothing there", Topic.NO_KINECT), Status.SKIPPED, False),
        (ConfigurationError("no folder"), Status.FAILED, False),
    ],
)
def test_a_source_that_does_not_open_is_told_by_kind(
    pi: PiTree, error: Exception, status: Status, hardware: bool
) -> None:
    def refuse(_settings: AgentSettings) -> Any:
        raise error

    finding, description = frames(pi.machine(open_source=refuse), AgentSettings())
    assert (finding.status, finding.hardware, description) == (status, hardware, None)


def test_a_terminal_gets_80_columns_and_a_pipe_one_line_a_finding() -> None:
    found = failed(Check.KEY, "a long sentence " * 12, "sudo " + "word " * 30, Topic.RIG_KEY)
    screen, pipe = io.StringIO(), io.StringIO()
    report.print_finding(Console(file=screen, force_terminal=True, width=120, highlight=False), found)
    report.print_finding(Console(file=pipe, width=80, highlight=False), found)
    drawn = re.sub(r"\x1b\[[0-9;]*m", "", screen.getvalue()).splitlines()
    commands = [line for line in drawn if "-> sudo" in line]
    assert len(commands) == 1, "a command that is broken in two cannot be copied"
    assert max(len(line) for line in drawn if line not in commands) <= 80
    lines = pipe.getvalue().splitlines()
    assert len(lines) == 3
    assert lines[0].startswith("failed")
    assert "\x1b" not in pipe.getvalue()


@pytest.mark.parametrize(
    ("found", "status"),
    [
        ([ok(Check.KEY, "fine"), warning(Check.SPACE, "little", None)], 0),
        ([ok(Check.KEY, "fine"), failed(Check.KINECT, "none", hardware=True)], 1),
    ],
)
def test_only_failures_fail(found: list[Finding], status: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(examination, "examine", lambda _machine, _settings: iter(found))
    words = ["--check", "--json", "--source", "synthetic"]
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == status
    told = json.loads(result.stdout)
    assert set(told) == {"software", "source", "passed", "passed_but_for_hardware", "checks"}
    assert [set(one) for one in told["checks"]] == [
        {"name", "status", "message", "fix", "skipped", "hardware", "see"}
    ] * 2


def test_scripts_know_three_statuses_and_what_was_skipped_is_none_of_their_trouble() -> None:
    told = [finding.to_dict() for finding in (skipped(Check.POWER, "no Pi"), failed(Check.KEY, "none"))]
    assert [(one["status"], one["skipped"]) for one in told] == [("ok", True), ("failed", False)]


def test_json_without_check_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="--json belongs to --check"):
        CliRunner().invoke(cli.app, ["--source", "synthetic", "--json"], catch_exceptions=False)


def test_the_page_lists_every_check_and_no_other() -> None:
    page = (ROOT / "docs" / "check.md").read_text()
    assert set(re.findall(r"^\| `([a-z0-9_.]+)` \|", page, re.M)) == {check.value for check in Check}
