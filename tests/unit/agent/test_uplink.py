"""Rules of the uplink that need no server: virtual time, a transport that only remembers."""

import pytest

from rig_agent import uplink as uplink_module
from rig_agent.config import AgentSettings
from rig_agent.hello import make_hello
from rig_agent.sources.base import SourceDescription
from rig_agent.transport import TransportCounters
from rig_agent.uplink import Uplink
from rig_protocol.camera import CameraModel
from rig_protocol.datagram import DatagramBatch
from rig_protocol.frames import EncodedFrame
from rig_protocol.rig_key import RigKey

SECOND_NS = 1_000_000_000
SETTINGS = AgentSettings(camera=0)
HELLO = make_hello(SETTINGS, SourceDescription(None, None, CameraModel(), 30.0, "bayer", "raw"))


class DeadTransport:
    """A network that takes everything and answers nothing."""

    def __init__(self, _server: object) -> None:
        self.counters = TransportCounters()
        self.opened = 0
        self.network = True
        self.sent: list[bytes] = []

    def open(self) -> bool:
        self.opened += 1
        return self.network

    def receive(self) -> list[bytes]:
        return []

    def send(self, batch: DatagramBatch) -> int:
        return len(batch)

    def send_datagram(self, data: bytes) -> None:
        self.sent.append(data)

    def fileno(self) -> None:
        return None

    def close(self) -> None:
        return


@pytest.fixture
def transport(monkeypatch: pytest.MonkeyPatch) -> DeadTransport:
    dead = DeadTransport(None)
    monkeypatch.setattr(uplink_module, "Transport", lambda _server: dead)
    return dead


def serve_until(uplink: Uplink, end_ns: int) -> None:
    """Serve whenever something is due, as the agent's loop does."""
    now_ns: int | None = 0
    while now_ns is not None and now_ns <= end_ns:
        uplink.serve(now_ns)
        due_ns = uplink.next_timeout_ns()
        now_ns = None if due_ns is None else max(due_ns, now_ns + 1)


def test_nothing_happens_before_the_introduction(transport: DeadTransport) -> None:
    uplink = Uplink(SETTINGS, RigKey.INSECURE)
    uplink.serve(0)
    assert uplink.next_timeout_ns() is None
    assert (transport.opened, transport.sent) == (0, [])


def test_an_unreachable_server_hears_hellos_and_its_name_is_looked_up_every_five_seconds(
    transport: DeadTransport,
) -> None:
    uplink = Uplink(SETTINGS, RigKey.INSECURE)
    uplink.introduce(HELLO, 0)
    serve_until(uplink, 21 * SECOND_NS)
    assert transport.opened == 5
    assert 20 <= len(transport.sent) <= 30


def test_without_a_network_the_way_out_is_tried_every_second(transport: DeadTransport) -> None:
    transport.network = False
    uplink = Uplink(SETTINGS, RigKey.INSECURE)
    uplink.introduce(HELLO, 0)
    serve_until(uplink, 10 * SECOND_NS + 1)
    assert transport.opened == 11


@pytest.mark.usefixtures("transport")
def test_frames_are_not_queued_while_nobody_listens() -> None:
    uplink = Uplink(SETTINGS, RigKey.INSECURE)
    uplink.introduce(HELLO, 0)
    uplink.send_frame(EncodedFrame(0, 0, 0), 0)
    assert (uplink.sent, uplink.dropped, uplink.unheard, uplink.welcome) == (0, 0, 1, None)


def test_closing_without_a_session_is_silent(transport: DeadTransport) -> None:
    uplink = Uplink(SETTINGS, RigKey.INSECURE)
    uplink.introduce(HELLO, 0)
    uplink.close(0)
    assert transport.sent == []
    assert uplink.next_timeout_ns() is None
