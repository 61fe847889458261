"""The server's link: sessions, stream plans, frames."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgpack
import pytest

from rig_protocol.agent_link import AgentLink
from rig_protocol.agent_session import HEARTBEAT_INTERVAL_NS
from rig_protocol.datagram import MAGIC, Buffer, DatagramBatch, MessageType, pack_prefix
from rig_protocol.errors import LinkUsageError
from rig_protocol.event_queue import MAX_FRAMES
from rig_protocol.events import CameraJoined, CameraLeft, FrameReceived, Rejected
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.gravity import Gravity
from rig_protocol.message_bytes import encode_body
from rig_protocol.messages import (
    ClockReply,
    ClockRequest,
    Goodbye,
    Heartbeat,
    Reject,
    RejectReason,
    StreamChoice,
    StreamPlan,
    UnknownSession,
)
from rig_protocol.server_link import ServerLink
from rig_protocol.server_session import GRAVITY_AGE_NS
from support.peers import AgentPeer
from support.server_sessions import (
    HELLO,
    STEP_NS,
    clear,
    deliver,
    joined,
    joined_peer,
    sealed_hello,
    session_id,
    welcomed,
)
from support.wire import (
    AGENT,
    COLOR,
    OTHER,
    SECOND_NS,
    T0,
    events_of,
    make_agent,
    make_frame,
    make_hello,
    make_server,
    roundtrip,
)

# ---- sessions


def test_an_unknown_session_is_answered_ten_times_a_second_at_most() -> None:
    server = make_server()
    datagram = pack_prefix(MessageType.HEARTBEAT, 0, 99) + bytes(24)
    for k in range(1000):
        server.receive_datagram(datagram, AGENT, T0 + k * 1_000_000)
    notices = server.datagrams_to_send(T0)
    assert len(notices) == 10
    assert notices[0] == (clear(UnknownSession(), 99), AGENT)
    assert len(notices[0][0]) == 16
    assert server.rejected == {"unknown_session": 1000}


def test_strangers_together_get_two_hundred_notices_a_second_at_most() -> None:
    server = make_server()
    datagram = pack_prefix(MessageType.HEARTBEAT, 0, 99) + bytes(24)
    for k in range(10_000):
        server.receive_datagram(datagram, ("198.51.100.1", k), T0 + k * 100_000)
    assert len(server.datagrams_to_send(T0)) == 200


def test_a_session_is_bound_to_its_address() -> None:
    server = make_server()
    peer = welcomed(server, AgentPeer())
    server.receive_datagram(peer.seal(Heartbeat({})), OTHER, T0)
    assert events_of(server) == []
    server.receive_datagram(peer.seal(Heartbeat({})), AGENT, T0)
    server.receive_datagram(peer.seal(Goodbye("")), OTHER, T0)
    assert server.cameras[0].connected
    assert server.rejected == {"wrong_address": 2}
    assert server.datagrams_to_send(T0) == []


@pytest.mark.parametrize(
    ("harm", "cause"),
    [
        (lambda d: d, "replayed"),
        (lambda d: d[:16] + b"\x09" + d[17:], "bad_seal"),
        (lambda d: d[:3] + bytes([MessageType.GOODBYE]) + d[4:16] + b"\x09" + d[17:], "bad_seal"),
        (lambda d: d[:30], "malformed"),
        (lambda d: d.ljust(1201, b"\0"), "malformed"),
    ],
    ids=["the same again", "another counter", "another type", "cut", "too long"],
)
def test_an_altered_or_repeated_message_changes_nothing(harm: Callable[[bytes], bytes], cause: str) -> None:
    server = make_server()
    peer = joined_peer(server)
    datagram = peer.seal(Heartbeat({"t": 1.0}))
    server.receive_datagram(datagram, AGENT, T0)
    server.receive_datagram(harm(datagram), AGENT, T0 + SECOND_NS)
    assert server.rejected == {cause: 1}
    server.handle_timeout(T0 + 2 * SECOND_NS)  # nor does it keep the session alive
    assert events_of(server) == [CameraLeft(0, "silent for 2.0 s")]


def test_a_message_of_one_session_is_not_accepted_in_another() -> None:
    server = make_server()
    first = joined_peer(server, seed=8)
    second = joined_peer(server, OTHER, T0 + STEP_NS, seed=9, camera_id=1, serial="S1")
    stolen = bytearray(first.seal(Goodbye("")))
    stolen[8:16] = second.seal(Heartbeat({}))[8:16]
    server.receive_datagram(bytes(stolen), OTHER, T0)
    assert server.rejected == {"bad_seal": 1}
    assert server.cameras[1].connected


def test_a_frame_of_one_session_is_not_accepted_in_another() -> None:
    server = make_server()
    first = joined_peer(server, seed=8)
    second = joined_peer(server, OTHER, T0 + STEP_NS, seed=9, camera_id=1, serial="S1")
    session = second.seal(Heartbeat({}))[8:16]
    for datagram in first.fragments(make_frame(timestamp_ns=T0), 0):
        moved = bytearray(datagram)
        moved[8:16] = session
        server.receive_datagram(bytes(moved), OTHER, T0)
    assert events_of(server) == []
    assert server.cameras[1].counters.corrupt == 1


def test_what_the_server_said_is_not_accepted_back_from_it() -> None:
    server = make_server()
    peer = joined_peer(server)
    server.close(T0)  # a goodbye: the one type that both ends send
    [(goodbye, _)] = server.datagrams_to_send(T0)
    assert peer.read([goodbye]) == [Goodbye("the server stops")]
    again = make_server()
    same = joined_peer(again)  # the same seeds: the same session and keys
    again.receive_datagram(goodbye, AGENT, T0)
    assert again.rejected == {"replayed": 1}  # by its counter, 0; under another one:
    again.receive_datagram(goodbye[:16] + b"\x07" + goodbye[17:], AGENT, T0)
    assert again.rejected == {"replayed": 1, "bad_seal": 1}
    again.receive_datagram(same.seal(Heartbeat({"still": 1.0})), AGENT, T0)
    assert again.cameras[0].health == {"still": 1.0}


def test_messages_that_overtook_each_other_are_all_taken() -> None:
    server = make_server()
    peer = joined_peer(server)
    datagrams = [peer.seal(Heartbeat({"k": float(k)})) for k in range(20)]
    seen = []
    for datagram in reversed(datagrams):
        server.receive_datagram(datagram, AGENT, T0)
        seen.append(server.cameras[0].health["k"])
    assert seen == list(range(19, -1, -1))


def test_a_silent_agent_leaves_after_two_seconds() -> None:
    server = make_server()
    peer = joined_peer(server)
    server.receive_datagram(peer.seal(Heartbeat({})), AGENT, T0 + SECOND_NS)
    server.handle_timeout(T0 + 3 * SECOND_NS - 1)
    assert events_of(server) == []
    server.handle_timeout(T0 + 3 * SECOND_NS)
    assert events_of(server) == [CameraLeft(0, "silent for 2.0 s")]
    assert not server.cameras[0].connected
    assert server.next_timeout_ns() is None


def test_a_goodbye_ends_the_session_with_its_text() -> None:
    server = make_server()
    server.receive_datagram(joined_peer(server).seal(Goodbye("device lost")), AGENT, T0)
    assert events_of(server) == [CameraLeft(0, "goodbye: device lost")]


def test_closing_says_goodbye_to_all_and_welcomes_nobody_after() -> None:
    server = make_server()
    peer = joined_peer(server)
    waiting = welcomed(server, AgentPeer(make_hello(camera_id=3, serial="S3"), seed=9), OTHER, T0 + STEP_NS)
    server.close(T0)
    assert peer.read(datagram for datagram, _ in server.datagrams_to_send(T0)) == [
        Goodbye("the server stops")
    ]
    events_of(server)
    server.receive_datagram(AgentPeer(seed=9).hello, AGENT, T0)
    assert server.datagrams_to_send(T0) == []
    assert server.rejected == {"closed": 1}
    server.receive_datagram(waiting.seal(Heartbeat({})), OTHER, T0)
    assert events_of(server) == []


def test_an_unnamed_camera_of_an_open_roster_gets_its_old_id_back() -> None:
    server = make_server()
    ids = []
    for k, serial in enumerate(("S0", "S1", "S1")):
        hello = make_hello(camera_id=None, serial=serial)
        agent = joined(server, hello, 10 + k, ("192.0.2.9", k), T0 + k * STEP_NS)
        assert agent.session is not None
        ids.append(agent.session.camera_id)
    assert ids == [0, 1, 1]


# ---- stream plans


CHOICE = StreamChoice(COLOR, None, 15.0, slot=3, slots=12, step_ns=1_000_000, spread=0.9)


def plans_of(server: ServerLink, peer: AgentPeer, now_ns: int) -> list[StreamPlan]:
    server.handle_timeout(now_ns)
    messages = peer.read(datagram for datagram, _ in server.datagrams_to_send(now_ns))
    requests = [message for message in messages if isinstance(message, ClockRequest)]
    for request in requests:  # an agent whose clock is 5 s and 123,456 ns behind, without any delay
        t2_ns = now_ns - 5_000_123_456
        server.receive_datagram(peer.seal(ClockReply(request.t1_ns, t2_ns, t2_ns)), AGENT, now_ns)
    return [message for message in messages if isinstance(message, StreamPlan)]


def test_a_plan_comes_with_every_clock_request_once_the_clock_is_known() -> None:
    server = make_server()
    peer = joined_peer(server)
    assert plans_of(server, peer, T0) == []
    server.plan_stream(0, CHOICE)
    server.rig_clock = "rig:0123"
    plans = [plan for k in range(1, 4) for plan in plans_of(server, peer, T0 + k * SECOND_NS // 2)]
    planned = StreamPlan(COLOR, None, 15.0, 1_000_000, 250_000, 0.9, 5_000_123_456, rig_clock="rig:0123")
    assert [replace(plan, offset_uncertainty_ns=None) for plan in plans] == [planned] * 3
    assert all(0 < (plan.offset_uncertainty_ns or 0) < 100_000 for plan in plans)


def test_a_plan_is_for_the_session_that_it_was_made_for() -> None:
    server = make_server()
    server.plan_stream(0, CHOICE)  # nobody is there: nothing to tell
    peer = joined_peer(server)
    assert plans_of(server, peer, T0) == []
    assert plans_of(server, peer, T0 + SECOND_NS) == []


@pytest.mark.parametrize(
    "changes",
    [
        {"fps": 0.0},
        {"step_ns": 0},
        {"slots": 0},
        {"slot": 12},
        {"slot": -1},
        {"color_codec": 0},
        {"spread": 0.0},
    ],
    ids=str,
)
def test_a_choice_that_no_plan_can_tell_is_misuse_at_once(changes: dict[str, Any]) -> None:
    server = make_server()
    joined_peer(server)
    with pytest.raises(LinkUsageError):
        server.plan_stream(0, replace(CHOICE, **changes))


# ---- frames


def test_a_frame_leaves_in_rig_time_with_both_uncertainties() -> None:
    server = make_server()
    agent = joined(server)
    deliver(server, agent, uncertainty_ns=30_000)
    [event] = events_of(server)
    assert isinstance(event, FrameReceived)
    assert event.frame.timestamp_ns == T0
    clock = server.cameras[0].clock
    assert clock is not None
    assert event.frame.uncertainty_ns >= 30_000
    assert event.frame.uncertainty_ns**2 >= 30_000**2 + clock.uncertainty_ns**2 - 1
    assert event.frame.color == make_frame().color


def test_frames_before_the_first_clock_exchange_wait_for_it_but_for_few() -> None:
    server = make_server()
    peer = joined_peer(server)
    for number in range(5):
        server.receive_batch(peer.fragments(make_frame(number, timestamp_ns=T0), number), AGENT, T0 + number)
    assert events_of(server) == []
    assert server.cameras[0].counters.untimed == 1
    server.handle_timeout(T0 + 5)
    [request] = peer.read(datagram for datagram, _ in server.datagrams_to_send(T0 + 5))
    assert isinstance(request, ClockRequest)
    server.receive_datagram(peer.seal(ClockReply(request.t1_ns, T0 + 5, T0 + 5)), AGENT, T0 + 5)
    frames = [event.frame for event in events_of(server)]
    assert [(frame.sequence, frame.received_ns) for frame in frames] == [(k, T0 + k) for k in range(4)]
    assert server.cameras[0].counters.frames == 4


def test_a_frame_tells_when_its_last_datagram_was_here() -> None:
    server = make_server()
    agent = joined(server)
    batch = agent.send_frame(make_frame(timestamp_ns=T0), T0)
    assert batch is not None
    for k, datagram in enumerate(batch):
        server.receive_datagram(datagram, AGENT, T0 + k * 1_000_000)
    [event] = events_of(server)
    assert event.frame.received_ns == T0 + (len(batch) - 1) * 1_000_000


@pytest.mark.parametrize("stamp_ns", [T0 + 9 * SECOND_NS, T0 - 11 * SECOND_NS, -(2**63), 2**63 - 1])
def test_a_frame_from_the_future_or_long_ago_is_untimed_and_the_clock_is_asked_soon(
    stamp_ns: int,
) -> None:
    server = make_server()
    agent = joined(server)
    now_ns = T0
    for _ in range(20):  # the quick exchanges of the beginning
        due_ns = server.next_timeout_ns()
        assert due_ns is not None
        now_ns = max(now_ns, due_ns)
        roundtrip(agent, server, AGENT, now_ns)
    server.handle_timeout(now_ns)
    assert server.next_timeout_ns() == now_ns + SECOND_NS // 4
    batch = agent.send_frame(make_frame(timestamp_ns=stamp_ns), now_ns)
    assert batch is not None
    server.receive_batch(batch, AGENT, now_ns)
    assert events_of(server) == []
    assert server.cameras[0].counters.untimed == 1
    asked_at = []
    for later_ns in (19_999_999, 20_000_000):
        server.handle_timeout(now_ns + later_ns)
        asked_at += [later_ns for _ in server.datagrams_to_send(now_ns + later_ns)]
    assert asked_at == [20_000_000]


def test_a_damaged_frame_is_delivered_flagged_and_counted() -> None:
    server = make_server()
    deliver(server, joined(server), damaged=True)
    [event] = events_of(server)
    assert event.frame.damaged
    assert server.cameras[0].counters.damaged == 1


def test_a_frame_in_a_codec_that_was_not_welcomed_is_refused() -> None:
    server = make_server()
    peer = joined_peer(server)
    frame = make_frame(timestamp_ns=T0, color=Payload(COLOR + 1, b"x"))
    server.receive_batch(peer.fragments(frame, 0), AGENT, T0)
    assert events_of(server) == []
    assert server.cameras[0].counters.unexpected_codec == 1


def test_a_change_of_codec_amid_the_session_loses_no_frame_not_even_one_under_way() -> None:
    server = make_server(color_codecs=(COLOR, COLOR + 1))
    agent = joined(server, make_hello(color_codecs=(COLOR, COLOR + 1)))
    server.plan_stream(0, replace(CHOICE, color_codec=COLOR + 1))
    for k, codec_id in enumerate((COLOR, COLOR + 1, COLOR, COLOR + 1)):
        deliver(server, agent, sequence=k, color=Payload(codec_id, b"x"))
    assert [event.frame.sequence for event in events_of(server)] == [0, 1, 2, 3]


def test_frames_that_nobody_fetches_are_bounded_and_the_oldest_goes() -> None:
    server = make_server()
    agent = joined(server)
    for sequence in range(MAX_FRAMES + 5):
        deliver(server, agent, sequence=sequence)
    frames = events_of(server)
    assert [event.frame.sequence for event in frames] == list(range(5, MAX_FRAMES + 5))
    assert server.cameras[0].counters.overflow == 5


def test_a_batch_may_mix_fragments_control_and_garbage() -> None:
    server = make_server()
    agent = joined(server)
    batch = agent.send_frame(make_frame(timestamp_ns=T0, size=1392), T0)
    assert batch is not None
    heartbeat = pack_prefix(MessageType.HEARTBEAT, 0, session_id(agent)).ljust(1472, b"\0")
    content = heartbeat + bytes(batch.buffer) + b"\xff" * 1472 + b"KR"
    server.receive_batch(DatagramBatch(content, 1472), AGENT, T0)
    assert [type(event) for event in events_of(server)] == [FrameReceived]
    assert server.rejected == {"malformed": 1, "bad_magic": 1, "too_short": 1}


@pytest.mark.parametrize(
    ("datagram", "cause"),
    [
        (b"", "too_short"),
        (bytes(15), "too_short"),
        (bytes(16), "bad_magic"),
        (MAGIC + bytes((1, MessageType.FRAGMENT)) + bytes(60), "other_version"),
        (MAGIC + bytes((2, 99)) + bytes(12), "unknown_type"),
        (clear(ClockRequest(1), 5), "unexpected_type"),
        (clear(Reject(RejectReason.OTHER, "x"), 5), "unexpected_type"),
        (HELLO[:-1], "corrupt_control"),
        (HELLO[:511], "malformed"),
        (sealed_hello(encode_body(make_hello())[1], nonce=0), "malformed"),
        (MAGIC + bytes((2, MessageType.FRAGMENT)) + bytes(12), "bad_fragment"),
        (MAGIC + bytes((2, MessageType.FRAGMENT)) + bytes(60), "bad_fragment"),
    ],
)
def test_an_unexpected_datagram_is_dropped_counted_and_not_answered(datagram: bytes, cause: str) -> None:
    server = make_server()
    server.receive_datagram(datagram, AGENT, T0)
    assert server.rejected == {cause: 1}
    assert server.datagrams_to_send(T0) == []
    assert events_of(server) == []


@pytest.mark.parametrize("body", [b"", b"\x80", b"\xff" * 8, b"\x81\xa6health\xc0"])
def test_a_malformed_message_of_a_session_is_counted(body: bytes) -> None:
    server = make_server()
    peer = joined_peer(server)
    server.receive_datagram(peer.seal_body(MessageType.HEARTBEAT, body), AGENT, T0)
    assert server.rejected == {"malformed": 1}


def test_a_clock_reply_without_its_request_is_counted() -> None:
    server = make_server()
    server.receive_datagram(joined_peer(server).seal(ClockReply(1, 2, 3)), AGENT, T0)
    assert server.cameras[0].counters.bad_clock_reply == 1


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_datagrams_may_be_any_bytes_like_object(kind: type) -> None:
    server, peer = make_server(), AgentPeer()
    datagram: Buffer = kind(peer.hello)
    server.receive_datagram(datagram, AGENT, T0)
    peer.accept(server.datagrams_to_send(T0)[0][0])
    datagram = kind(peer.seal(Heartbeat({})))
    server.receive_datagram(datagram, AGENT, T0)
    assert [type(event) for event in events_of(server)] == [CameraJoined]


@pytest.mark.parametrize("size", [1199, 65508])
def test_a_datagram_size_out_of_range_is_misuse(size: int) -> None:
    with pytest.raises(LinkUsageError):
        make_server(datagram_size=size)


def test_a_camera_that_the_owner_objects_to_is_refused_readably_and_holds_nothing() -> None:
    server = make_server(objection=lambda *_: "the port is full")
    agent = make_agent()
    roundtrip(agent, server)
    assert not agent.connected
    assert events_of(agent) == [Rejected(RejectReason.NO_ROOM, "the port is full")]
    assert server.rejected == {"refused_no_room": 1}
    assert server.next_timeout_ns() is None


def test_when_the_rig_clock_is_set_back_all_agents_are_asked_to_come_again() -> None:
    server = make_server()
    peer = joined_peer(server, now_ns=T0 + 3_600 * SECOND_NS)
    server.receive_datagram(peer.seal(Heartbeat({})), AGENT, T0)
    assert events_of(server) == [CameraLeft(0, "the rig clock was set back")]
    (datagram, address), _ = server.datagrams_to_send(T0)  # and that it has no session any more
    assert (peer.read([datagram]), address) == ([Goodbye("the rig clock was set back")], AGENT)
    joined_peer(server, now_ns=T0, seed=9)


# ---- gravity


def frame_after(server: ServerLink, agent: AgentLink, sequence: int, now_ns: int) -> EncodedFrame:
    deliver(server, agent, now_ns, sequence=sequence)
    [frame] = [event.frame for event in events_of(server) if isinstance(event, FrameReceived)]
    return frame


def test_a_frame_carries_what_the_latest_heartbeat_told_of_gravity() -> None:
    server = make_server()
    agent = joined(server)
    told = (Gravity((0.0, 1.0, 0.0)), Gravity((1.0, 0.0, 0.0)), None)
    for k, gravity in enumerate(told):
        now_ns = T0 + (k + 1) * HEARTBEAT_INTERVAL_NS
        agent.gravity = gravity
        roundtrip(agent, server, now_ns=now_ns)
        assert frame_after(server, agent, k, now_ns).gravity == gravity


def test_gravity_that_was_told_long_ago_says_nothing_of_a_frame() -> None:
    server = make_server()
    agent = joined(server)
    agent.gravity = Gravity((0.0, 1.0, 0.0))
    told_ns = T0 + HEARTBEAT_INTERVAL_NS
    roundtrip(agent, server, now_ns=told_ns)
    # No heartbeat comes any more, but frames do.
    late_ns = told_ns + GRAVITY_AGE_NS
    assert frame_after(server, agent, 0, late_ns - SECOND_NS).gravity == agent.gravity
    assert frame_after(server, agent, 1, late_ns + 1).gravity is None


def test_a_heartbeat_with_hostile_gravity_is_counted_and_tells_nothing() -> None:
    server = make_server()
    peer = joined_peer(server)
    body = msgpack.packb({"health": {}, "frames": 0, "gravity": {"down": [0, 0, 0], "sigma_deg": 1}})
    server.receive_datagram(peer.seal_body(MessageType.HEARTBEAT, body), AGENT, T0)
    assert server.rejected == {"malformed": 1}
