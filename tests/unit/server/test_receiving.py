"""Rules of the server's ordinary loop: what systemd hears of it."""

import io
import socket
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import cast

import pytest
from rich.console import Console

from rig_server import receiving
from rig_server.metrics import RigStatus
from rig_server.receiving import receive
from rig_server.rig import Rig


class TurningRig:
    """A rig without cameras whose receiver has made so many turns at each look; then Ctrl-C."""

    place = "UDP 127.0.0.1:0"
    ended = False

    def __init__(self, turns: Iterable[int]) -> None:
        self._turns = iter(turns)

    def __enter__(self) -> "TurningRig":
        return self

    def __exit__(self, *_: object) -> None:
        return

    def next_panorama(self, _timeout_s: float) -> None:
        return

    def status(self) -> RigStatus:
        try:
            return RigStatus((), turns=next(self._turns))
        except StopIteration:
            raise KeyboardInterrupt from None


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """What systemd listens with; the watchdog's limit is so short that each meal is due at once."""
    monkeypatch.setattr(receiving, "_UPDATE_S", 0.0)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("WATCHDOG_USEC", "0")
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(5)
        yield manager


def heard(systemd: socket.socket, turns: Iterable[int]) -> list[bytes]:
    receive(cast(Rig, TurningRig(turns)), Console(file=io.StringIO()))
    systemd.setblocking(False)
    words = []
    while True:
        try:
            words.append(systemd.recv(100))
        except BlockingIOError:
            return words


def test_systemd_hears_of_the_beginning_of_life_and_of_the_end(systemd: socket.socket) -> None:
    assert heard(systemd, [5, 9, 14]) == [b"READY=1", *[b"WATCHDOG=1"] * 3, b"STOPPING=1"]


def test_a_receiver_that_hangs_starves_the_watchdog_though_this_loop_goes_on(systemd: socket.socket) -> None:
    assert heard(systemd, [5, 5, 5, 5, 5]) == [b"READY=1", b"WATCHDOG=1", b"STOPPING=1"]
