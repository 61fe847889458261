"""Rules of the commands that speak to the running server: over its socket, to agents on loopback."""

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rig_protocol.errors import ConfigurationError
from rig_server import Rig
from rig_server.cli import main
from rig_server.config import RigSettings
from rig_server.control_catalogue import CATALOGUE, parse_value
from rig_server.operator_requests import OperatorRequests
from rig_server.operator_socket import operator_served
from support.small_agent import SmallAgent

Operator = Callable[..., int]
SETTINGS = RigSettings(listen="127.0.0.1:0", insecure=True, expected_cameras=2)


@pytest.fixture
def agents(tmp_path: Path) -> Iterator[tuple[SmallAgent, SmallAgent]]:
    """Two agents of a running rig whose door is `control.sock`."""
    with Rig.live(SETTINGS) as rig:
        host, port = rig.place.removeprefix("UDP ").split(":")
        with SmallAgent(0, (host, int(port))) as first, SmallAgent(1, (host, int(port))) as second:
            rig.wait_for_cameras(10)
            with operator_served(tmp_path / "control.sock", OperatorRequests(rig)):
                yield first, second


@pytest.fixture
def operator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Operator:
    """Run `rig-server` with some words; its exit status."""
    monkeypatch.chdir(tmp_path)

    def run(*words: str) -> int:
        monkeypatch.setattr(sys, "argv", ["rig-server", *words])
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0)

    return run


def test_one_camera_is_controlled_by_its_name(
    agents: tuple[SmallAgent, SmallAgent], operator: Operator, capsys: pytest.CaptureFixture[str]
) -> None:
    assert operator("control", "pi-1", "depth", "off", "--socket", "control.sock") == 0
    assert capsys.readouterr().out == "pi-1: depth is False\n"
    assert [agent.done for agent in agents] == [[], [("depth", False)]]


def test_all_cameras_are_controlled_and_what_they_refuse_is_the_exit_status(
    agents: tuple[SmallAgent, SmallAgent], operator: Operator, capsys: pytest.CaptureFixture[str]
) -> None:
    assert operator("control", "all", "tilt_deg", "4", "--socket", "control.sock") == 0
    assert [agent.done for agent in agents] == [[("tilt_deg", 4.0)]] * 2
    assert operator("control", "all", "sing", "--json", "--socket", "control.sock") == 1
    results = json.loads(capsys.readouterr().out.partition("{")[2].join(["{", ""]))["results"]
    assert [one["outcome"] for one in results] == ["refused"] * 2


def test_a_camera_shows_which_it_is_and_then_no_more(
    agents: tuple[SmallAgent, SmallAgent], operator: Operator
) -> None:
    assert operator("identify", "0", "--seconds", "0", "--socket", "control.sock") == 0
    assert agents[0].done == [("led", "blink_red_yellow"), ("led", "green")]


def test_a_camera_that_there_is_not_is_wrong_usage_and_the_others_are_named(
    agents: tuple[SmallAgent, SmallAgent], operator: Operator, capsys: pytest.CaptureFixture[str]
) -> None:
    assert operator("control", "pi-9", "depth", "off", "--socket", "control.sock") == 2
    assert "pi-0 (0), pi-1 (1)" in capsys.readouterr().err.replace("\n", " ")
    assert not agents[0].done


def test_the_cameras_of_the_rig_are_listed(
    agents: tuple[SmallAgent, SmallAgent], operator: Operator, capsys: pytest.CaptureFixture[str]
) -> None:
    assert operator("agents", "--json", "--socket", "control.sock") == 0
    listed = json.loads(capsys.readouterr().out)["cameras"]
    assert [(one["camera"], one["name"], one["serial"]) for one in listed] == [
        (agent.camera_id, f"pi-{agent.camera_id}", f"S{agent.camera_id}") for agent in agents
    ]


def test_without_a_running_server_there_is_nobody_to_control(
    operator: Operator, capsys: pytest.CaptureFixture[str]
) -> None:
    assert operator("control", "all", "depth", "off", "--socket", "control.sock") == 1
    assert "no running rig-server" in capsys.readouterr().err


def test_the_list_of_controls_needs_no_server(operator: Operator, capsys: pytest.CaptureFixture[str]) -> None:
    assert operator("control", "--list") == 0
    shown = capsys.readouterr().out
    assert all(entry.name in shown for entry in CATALOGUE)


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("led", "off", "off"),
        ("depth", "off", False),
        ("depth", "On", True),
        ("tilt_deg", "-4.5", -4.5),
        ("restart", None, True),
        ("of_a_newer_agent", "on", True),
        ("of_a_newer_agent", "3", 3.0),
        ("of_a_newer_agent", "word", "word"),
    ],
)
def test_values_are_read_as_their_control_means_them(name: str, text: str | None, value: object) -> None:
    read = parse_value(name, text)
    assert read == value
    assert type(read) is type(value)


@pytest.mark.parametrize(("name", "text"), [("depth", "perhaps"), ("tilt_deg", "up"), ("led", None)])
def test_values_that_a_control_cannot_have_are_wrong_usage(name: str, text: str | None) -> None:
    with pytest.raises(ConfigurationError, match=name):
        parse_value(name, text)
