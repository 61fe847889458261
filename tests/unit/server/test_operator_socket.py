"""Rules of the operator's door: who may come in, what happens at the wrong place, and nothing hangs on it."""

import json
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from rig_protocol.errors import ConfigurationError, RigError
from rig_server.operator_socket import MAX_LINE, Answer, OperatorSocket, Request, ask_server, operator_served


def echo(request: Request) -> Answer:
    """Gives the request back; some words are trouble."""
    if request.get("do") == "refuse":
        raise ConfigurationError("that makes no sense")
    if request.get("do") == "break":
        raise ZeroDivisionError
    return {"got": request}


@pytest.fixture
def door(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "control.sock"
    with operator_served(path, echo):
        yield path


def test_a_request_is_answered(door: Path) -> None:
    assert ask_server(door, {"do": "this"})["got"] == {"do": "this"}


def test_nobody_but_its_user_may_come_in(door: Path) -> None:
    assert stat.S_IMODE(door.stat().st_mode) == 0o600


def test_what_the_server_refuses_is_the_same_error_at_the_operators(door: Path) -> None:
    with pytest.raises(ConfigurationError, match="that makes no sense"):
        ask_server(door, {"do": "refuse"})


def test_a_request_that_breaks_something_is_told_and_the_door_stays_open(door: Path) -> None:
    with pytest.raises(RigError, match="ZeroDivisionError"):
        ask_server(door, {"do": "break"})
    assert ask_server(door, {})["got"] == {}


@pytest.mark.parametrize("line", [b"", b"\n", b"[1]\n", b"{\n", b"\xff\n", b"[" * MAX_LINE, b"x" * MAX_LINE])
def test_no_bytes_harm_the_door(door: Path, line: bytes) -> None:
    with socket.socket(socket.AF_UNIX) as stranger:
        stranger.connect(str(door))
        stranger.sendall(line)
        stranger.shutdown(socket.SHUT_WR)
        answer = stranger.makefile("rb").readline()
    assert json.loads(answer)["exit_status"] == 2
    assert ask_server(door, {})["got"] == {}


def test_without_a_server_the_operator_is_told_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(RigError, match=r"no running rig-server can be reached .*start one"):
        ask_server(tmp_path / "control.sock", {})


def test_a_second_server_does_not_take_the_door_of_the_first(door: Path) -> None:
    with pytest.raises(ConfigurationError, match="another rig-server listens"), operator_served(door, echo):
        pass
    assert ask_server(door, {})["got"] == {}


def test_the_socket_of_a_server_that_was_killed_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    with operator_served(path, echo):
        assert ask_server(path, {})["got"] == {}


def test_a_file_that_is_no_socket_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text("")
    with pytest.raises(ConfigurationError, match="no socket"), operator_served(path, echo):
        pass
    assert path.exists()


def test_the_socket_is_gone_when_the_server_has_ended(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    door = OperatorSocket(path, echo)
    door.close()
    assert not path.exists()
    door.close()


def test_a_server_without_a_usual_place_goes_on_without_a_door(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr("rig_server.operator_socket.SERVICE_SOCKET", Path("/nowhere/control.sock"))
    with operator_served(None, echo):
        pass


def test_operators_find_the_server_where_it_is_usual(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr("rig_server.operator_socket.SERVICE_SOCKET", Path("/nowhere/control.sock"))
    with operator_served(None, echo):
        assert ask_server(None, {"do": 1})["got"] == {"do": 1}
    assert stat.S_IMODE((tmp_path / "kinect-rig").stat().st_mode) == 0o700
