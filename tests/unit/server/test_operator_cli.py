"""Rules of the commands that speak to the running server: over its socket, to agents on loopback."""

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rig_protocol.errors import ConfigurationError
from rig_server import Rig
from rig_server.cli import main
from rig_server.config import RigSettings, load_rig_settings
from rig_server.control_catalogue import CATALOGUE, parse_value
from rig_server.operator_cli import _identity
from rig_server.operator_requests import OperatorRequests
from rig_server.operator_socket import operator_served
from rig_server.status_words import summary
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
        ("restart", "usb", "usb"),
        ("color", "ir", "ir"),
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


@pytest.fixture
def listed(tmp_path: Path) -> Iterator[Rig]:
    """A running rig whose rig.toml lists slot 1 for another camera than the one that comes."""
    (tmp_path / "rig.toml").write_text(
        """listen = "127.0.0.1:0"\ninsecure = true\n[[cameras]]\nid = 1 # right\nserial = "OTHER"\n"""
    )
    rig = Rig.live(load_rig_settings(tmp_path / "rig.toml"))
    with rig, operator_served(tmp_path / "control.sock", OperatorRequests(rig)):
        yield rig


def test_an_agent_without_a_slot_is_listed_and_can_be_given_one(
    listed: Rig, operator: Operator, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    host, port = listed.place.removeprefix("UDP ").split(":")
    with SmallAgent(1, (host, int(port))):
        while not listed.status().unassigned:
            listed.next_panorama(0.05)
        assert any("S1" in line for line in summary(listed.status())[1])
        assert operator("agents", "--socket", "control.sock") == 0
        assert "rig-server assign S1 SLOT" in capsys.readouterr().out
        assert operator("assign", "pi-1", "1", "--socket", "control.sock") == 0
        listed.wait_for_cameras(10)  # it is taken without a restart of either side
        assert listed.hellos[1].serial == "S1"
        assert not listed.status().unassigned
    [camera] = load_rig_settings(tmp_path / "rig.toml").cameras
    assert (camera.id, camera.serial) == (1, "S1")
    assert "# right" in (tmp_path / "rig.toml").read_text()


@pytest.mark.usefixtures("listed")
def test_an_agent_that_is_not_here_is_assigned_only_by_its_serial_number_offline(
    operator: Operator, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (tmp_path / "rig.toml").read_text()
    assert operator("assign", "S7", "3", "--socket", "control.sock") == 2
    assert "--offline" in capsys.readouterr().err
    assert (tmp_path / "rig.toml").read_text() == before
    assert operator("assign", "S7", "3", "--offline") == 0
    assert [camera.id for camera in load_rig_settings(tmp_path / "rig.toml").cameras] == [1, 3]


@pytest.mark.parametrize(
    ("serial", "port_path", "other_port"), [(None, None, "1-1"), ("0000000000", "1-1", "1-1")]
)
def test_a_kinect_that_nothing_identifies_needs_its_slot_in_its_own_settings(
    serial: str | None, port_path: str | None, other_port: str
) -> None:
    agent = {"name": "pi-1", "host": "a", "serial": serial, "port_path": port_path, "camera_id": None}
    other = {"name": "pi-2", "host": "b", "serial": serial, "port_path": other_port, "camera_id": None}
    with pytest.raises(ConfigurationError, match=r"agent\.toml"):
        _identity("pi-1", {"unassigned": [agent, other], "cameras": []})


def test_a_kinect_without_a_serial_number_is_known_by_a_port_that_nobody_shares() -> None:
    agent = {"name": "pi-1", "host": "a", "serial": None, "port_path": "1-1.3", "camera_id": None}
    assert _identity("pi-1", {"unassigned": [agent], "cameras": []}) == {"serial": None, "port_path": "1-1.3"}
