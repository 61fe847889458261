"""Rules of discovery: agents find a server that announces itself, on real multicast of loopback."""

import secrets
import socket
import time
from collections.abc import Iterator
from contextlib import closing

import pytest
from zeroconf import Zeroconf

from rig_agent.config import AgentSettings
from rig_agent.discovery import ServerFinder
from rig_agent.transport import Transport
from rig_protocol.events import Address
from rig_server.announcement import announced

LOOPBACK = ("127.0.0.1",)
PATIENCE_S = 20.0


@pytest.fixture(scope="module", autouse=True)
def _multicast() -> None:
    """Two ends on loopback must hear each other."""
    try:
        with closing(Zeroconf(list(LOOPBACK))):
            pass
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(LOOPBACK[0]))
            probe.sendto(b"", ("224.0.0.251", 5353))
    except OSError as error:
        pytest.skip(f"loopback carries no multicast here ({error}): ip route add 224.0.0.0/4 dev lo")


@pytest.fixture(autouse=True)
def _kind_of_our_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loopback's multicast reaches every process of this machine: other tests must not be found."""
    kind = f"_kr{secrets.token_hex(5)}._udp.local."
    monkeypatch.setattr("rig_agent.discovery.SERVICE_TYPE", kind)
    monkeypatch.setattr("rig_server.announcement.SERVICE_TYPE", kind)


@pytest.fixture
def finder() -> Iterator[ServerFinder]:
    with closing(ServerFinder(LOOPBACK)) as finder:
        yield finder


def found(finder: ServerFinder) -> Address | None:
    """The first address that is found, awaited."""
    return awaited(finder, None)


def awaited(finder: ServerFinder, before: Address | None) -> Address | None:
    """The next address that is not `before`."""
    until_s = time.monotonic() + PATIENCE_S
    while (address := finder.next_address()) == before and time.monotonic() < until_s:
        time.sleep(0.02)
    return address


def test_an_agent_finds_a_server_that_announces_itself(finder: ServerFinder) -> None:
    with announced(("127.0.0.1", 4017), LOOPBACK):
        assert found(finder) == ("127.0.0.1", 4017)


def test_a_server_that_comes_later_is_found_and_one_that_has_gone_is_not(finder: ServerFinder) -> None:
    assert finder.next_address() is None
    with announced(("127.0.0.1", 4018), LOOPBACK):
        assert found(finder) == ("127.0.0.1", 4018)
    assert awaited(finder, ("127.0.0.1", 4018)) is None


def test_several_servers_are_tried_in_turn(finder: ServerFinder) -> None:
    """The key tells which of them is the agent's own."""
    with announced(("127.0.0.1", 4019), LOOPBACK), announced(("127.0.0.1", 4020), LOOPBACK):
        first = found(finder)
        assert {first, awaited(finder, first)} == {("127.0.0.1", 4019), ("127.0.0.1", 4020)}


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1"])
def test_a_server_that_only_this_machine_reaches_announces_nothing(
    host: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("zeroconf.Zeroconf", lambda *_: pytest.fail("it speaks to the network"))
    with announced((host, 4021)):
        pass


def test_the_agents_socket_goes_to_the_server_that_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig_agent.transport.ServerFinder", lambda: ServerFinder(LOOPBACK))
    with closing(Transport(AgentSettings(server="auto").address)) as transport:
        assert not transport.open()
        with announced(("127.0.0.1", 4022), LOOPBACK):
            until_s = time.monotonic() + PATIENCE_S
            while not transport.open():
                assert time.monotonic() < until_s
                time.sleep(0.02)
            assert transport.server == "127.0.0.1:4022"
