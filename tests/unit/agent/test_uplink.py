"""Rules of the uplink that need no server: virtual time, a transport that only remembers."""

from dataclasses import replace

import pytest

from rig_agent import uplink as uplink_module
from rig_agent.config import AgentSettings, PacingSettings
from rig_agent.hello import make_hello
from rig_agent.sources.base import SourceDescription
from rig_agent.transport import TransportCounters
from rig_agent.uplink import Uplink, Wanted
from rig_protocol.camera import CameraModel
from rig_protocol.datagram import DatagramBatch, parse_fragment_header
from rig_protocol.frames import EncodedFrame
from rig_protocol.gravity import Gravity
from rig_protocol.messages import ClockRequest, Goodbye, Heartbeat, Resend, StreamPlan
from rig_protocol.rig_key import RigKey
from support.peers import ServerPeer
from support.wire import COLOR, DEPTH, KEY, make_frame

SECOND_NS = 1_000_000_000
SETTINGS = AgentSettings(camera=0)
HELLO = make_hello(SETTINGS, SourceDescription(None, None, CameraModel(), 30.0, "bayer", "raw"))


class MemoryTransport:
    """A network that takes everything, and brings what a test lays into `arrived`."""

    def __init__(self, _server: object) -> None:
        self.counters = TransportCounters()
        self.opened = 0
        self.network = True
        self.sent: list[bytes] = []
        self.fragments: list[bytes] = []
        self.arrived: list[bytes] = []

    def open(self) -> bool:
        self.opened += 1
        return self.network

    def receive(self) -> list[bytes]:
        arrived, self.arrived = self.arrived, []
        return arrived

    def send(self, batch: DatagramBatch) -> int:
        self.fragments += [bytes(datagram) for datagram in batch]
        return len(batch)

    def server_reached(self) -> None:
        return

    def send_datagram(self, data: bytes) -> None:
        self.sent.append(data)

    def limit_rate(self, bytes_per_s: float) -> None:
        self.rate = bytes_per_s

    def fileno(self) -> None:
        return None

    def close(self) -> None:
        return


@pytest.fixture
def transport(monkeypatch: pytest.MonkeyPatch) -> MemoryTransport:
    dead = MemoryTransport(None)
    monkeypatch.setattr(uplink_module, "Transport", lambda _server: dead)
    return dead


def serve_until(uplink: Uplink, end_ns: int) -> None:
    """Serve whenever something is due, as the agent's loop does."""
    now_ns: int | None = 0
    while now_ns is not None and now_ns <= end_ns:
        uplink.serve(now_ns)
        due_ns = uplink.next_timeout_ns()
        now_ns = None if due_ns is None else max(due_ns, now_ns + 1)


def test_nothing_happens_before_the_introduction(transport: MemoryTransport) -> None:
    uplink = Uplink(SETTINGS, RigKey.INSECURE)
    uplink.serve(0)
    assert uplink.next_timeout_ns() is None
    assert (transport.opened, transport.sent) == (0, [])


def test_an_unreachable_server_hears_hellos_and_its_name_is_looked_up_every_five_seconds(
    transport: MemoryTransport,
) -> None:
    uplink = Uplink(SETTINGS, RigKey.INSECURE)
    uplink.introduce(HELLO, 0)
    serve_until(uplink, 21 * SECOND_NS)
    assert transport.opened == 5
    assert 20 <= len(transport.sent) <= 30


def test_without_a_network_the_way_out_is_tried_every_second(transport: MemoryTransport) -> None:
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


def test_closing_without_a_session_is_silent(transport: MemoryTransport) -> None:
    uplink = Uplink(SETTINGS, RigKey.INSECURE)
    uplink.introduce(HELLO, 0)
    uplink.close(0)
    assert transport.sent == []
    assert uplink.next_timeout_ns() is None


# ---- with a server


def connected(transport: MemoryTransport, uplink: Uplink) -> ServerPeer:
    """A server that has welcomed the agent."""
    server = ServerPeer(RigKey.INSECURE)
    transport.arrived.append(server.welcome(transport.sent[-1], color_codecs=(COLOR, COLOR + 1), camera_id=4))
    uplink.serve(0)
    transport.arrived.append(server.seal(ClockRequest(0)))
    uplink.serve(0)
    assert uplink.connections == 1
    return server


@pytest.fixture
def uplink(transport: MemoryTransport) -> Uplink:
    """Introduced, its hello sent, its pace not spread."""
    quick = SETTINGS.model_copy(update={"pacing": PacingSettings(spread=0.0)})
    uplink = Uplink(quick, RigKey.INSECURE)
    uplink.introduce(HELLO, 0)
    uplink.serve(0)
    assert transport.sent
    return uplink


PLAN = StreamPlan(COLOR + 1, None, 15.0, 1_000_000, 350_000, 0.8, offset_ns=7_000_100_000)


def test_before_any_plan_the_first_codecs_of_the_welcome_are_wanted_at_full_rate(
    transport: MemoryTransport, uplink: Uplink
) -> None:
    assert uplink.wanted is None
    connected(transport, uplink)
    assert uplink.wanted == Wanted(4, COLOR, DEPTH, None)


def test_a_plan_says_what_is_wanted_and_the_next_one_replaces_it(
    transport: MemoryTransport, uplink: Uplink
) -> None:
    server = connected(transport, uplink)
    for plan in (PLAN, replace(PLAN, color_codec=COLOR, depth_codec=DEPTH, fps=30.0)):
        transport.arrived.append(server.seal(plan))
        uplink.serve(0)
        assert uplink.wanted == Wanted(4, plan.color_codec, plan.depth_codec, plan.fps, plan.offset_ns)


def test_frames_leave_on_the_grid_of_the_plan_and_in_its_interval(transport: MemoryTransport) -> None:
    uplink = Uplink(SETTINGS, RigKey.INSECURE)
    uplink.introduce(HELLO, 0)
    uplink.serve(0)
    server = connected(transport, uplink)
    transport.arrived.append(server.seal(PLAN))
    uplink.serve(1)
    uplink.send_frame(make_frame(size=200_000, color=None), 1)
    times, now_ns = [], 1
    while uplink.sent == 0:
        before = len(transport.fragments)
        due_ns = uplink.next_timeout_ns()
        assert due_ns is not None
        now_ns = max(now_ns, due_ns)
        uplink.serve(now_ns)
        times += [now_ns] * (len(transport.fragments) > before)
    assert {time_ns % 1_000_000 for time_ns in times} == {250_000}
    # 47 fragments over 0.8 of the 66.7 ms between frames at 15 a second, one a step.
    assert 40_000_000 < times[-1] < 0.8 * SECOND_NS / 15


def test_what_the_server_missed_is_sent_again(transport: MemoryTransport, uplink: Uplink) -> None:
    server = connected(transport, uplink)
    uplink.send_frame(make_frame(), 0)
    serve_until(uplink, 1_000_000)
    first = list(transport.fragments)
    transport.arrived.append(server.seal(Resend(0, ((1, 1),))))
    uplink.serve(2_000_000)
    assert transport.fragments == [*first, first[1]]
    assert uplink.resent == 1
    uplink.introduce(HELLO, 3_000_000)
    assert uplink.resent == 1


def test_a_frame_that_gives_way_to_a_newer_one_leaves_no_gap_in_the_numbers(
    transport: MemoryTransport, uplink: Uplink
) -> None:
    connected(transport, uplink)
    for _ in range(3):  # nothing is served in between: the second gives way to the third
        uplink.send_frame(make_frame(), 0)
    assert uplink.dropped == 1
    serve_until(uplink, 100_000_000)
    headers = [parse_fragment_header(fragment) for fragment in transport.fragments]
    assert {header.frame_number for header in headers if header is not None} == {0, 1}
    assert uplink.sent == 2


def test_a_lost_session_drops_what_is_unsent_and_its_plan(transport: MemoryTransport, uplink: Uplink) -> None:
    server = connected(transport, uplink)
    transport.arrived.append(server.seal(PLAN))
    uplink.serve(0)
    uplink.send_frame(make_frame(color=None), 0)
    transport.arrived.append(server.seal(Goodbye("the server stops")))
    uplink.serve(0)
    assert (uplink.wanted, uplink.dropped, transport.fragments) == (None, 1, [])
    connected_again = ServerPeer(RigKey.INSECURE, seed=9)
    transport.arrived.append(connected_again.welcome(transport.sent[-1]))
    uplink.serve(0)
    transport.arrived.append(connected_again.seal(ClockRequest(0)))
    uplink.serve(0)
    assert uplink.wanted == Wanted(4, COLOR, DEPTH, None)


def test_what_the_camera_feels_is_told_to_the_server(transport: MemoryTransport, uplink: Uplink) -> None:
    server, felt = connected(transport, uplink), Gravity((0.0, 1.0, 0.0))
    transport.sent.clear()
    uplink.report_gravity(felt)
    uplink.serve(1)
    assert Heartbeat({}, gravity=felt) in server.read(transport.sent)


def test_a_server_with_another_key_gets_no_frame(transport: MemoryTransport, uplink: Uplink) -> None:
    impostor = ServerPeer(KEY)
    transport.arrived.append(impostor.welcome(transport.sent[-1]))
    transport.arrived.append(impostor.seal(ClockRequest(0)))
    uplink.serve(0)
    uplink.send_frame(make_frame(), 0)
    serve_until(uplink, SECOND_NS)
    assert (uplink.connections, uplink.unheard, transport.fragments) == (0, 1, [])
