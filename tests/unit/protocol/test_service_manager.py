"""Rules of what systemd is told."""

import os

import pytest

from rig_protocol.service_manager import ServiceManager

SECOND_NS = 1_000_000_000
Sent = list[tuple[bytes, str]]


def started_by_systemd(monkeypatch: pytest.MonkeyPatch, **environment: str) -> tuple[ServiceManager, Sent]:
    for name in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    sent: Sent = []
    return ServiceManager(lambda data, address: sent.append((data, address))), sent


def test_a_state_goes_to_the_socket_that_systemd_named(monkeypatch: pytest.MonkeyPatch) -> None:
    manager, sent = started_by_systemd(monkeypatch, NOTIFY_SOCKET="/run/systemd/notify")
    manager.notify("READY=1")
    assert sent == [(b"READY=1", "/run/systemd/notify")]


def test_an_address_with_an_at_sign_is_an_abstract_one(monkeypatch: pytest.MonkeyPatch) -> None:
    manager, sent = started_by_systemd(monkeypatch, NOTIFY_SOCKET="@notify")
    manager.notify("READY=1")
    assert sent == [(b"READY=1", "\0notify")]


def test_the_watchdog_is_fed_twice_in_its_limit_however_often_we_call(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    manager, sent = started_by_systemd(monkeypatch, NOTIFY_SOCKET="/n", WATCHDOG_USEC="2000000")
    for tenth in range(25):
        manager.feed_watchdog(5 * SECOND_NS + tenth * SECOND_NS // 10)
    assert sent == [(b"WATCHDOG=1", "/n")] * 3


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"WATCHDOG_USEC": "2000000"},
        {"NOTIFY_SOCKET": "/n", "WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid() + 1)},
        {"NOTIFY_SOCKET": "/n", "WATCHDOG_USEC": "soon"},
    ],
    ids=["no systemd", "no socket", "the limit of another process", "a limit that is no number"],
)
def test_a_watchdog_that_is_not_ours_is_not_fed(
    monkeypatch: pytest.MonkeyPatch, environment: dict[str, str]
) -> None:
    manager, sent = started_by_systemd(monkeypatch, **environment)
    manager.feed_watchdog(SECOND_NS)
    assert sent == []


def test_a_manager_that_is_gone_is_no_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", "/gone")

    def refuse(_data: bytes, address: str) -> None:
        raise FileNotFoundError(address)

    ServiceManager(refuse).notify("READY=1")
