from typing import Any

import msgpack
import pytest

from rig_protocol.agent_link import AgentLink
from rig_protocol.datagram import MAGIC, Buffer, DatagramBatch, MessageType, pack_prefix, parse_prefix
from rig_protocol.errors import LinkUsageError
from rig_protocol.event_queue import MAX_FRAMES
from rig_protocol.events import Address, CameraJoined, CameraLeft, FrameReceived, HelloRefused
from rig_protocol.frames import Payload
from rig_protocol.message_bytes import MIN_HELLO_SIZE, control_crc, decode_message, encode_message
from rig_protocol.messages import (
    ClockReply,
    ClockRequest,
    Goodbye,
    Heartbeat,
    Hello,
    Message,
    Reject,
    RejectReason,
    UnknownSession,
    Welcome,
)
from rig_protocol.roster import Roster, Slot
from rig_protocol.server_link import ServerLink
from support.wire import (
    AGENT,
    COLOR,
    DEPTH,
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

HELLO = encode_message(make_hello(), 1)


def with_crc(datagram: bytes | bytearray) -> bytes:
    """The datagram with the crc that it should have."""
    return bytes(datagram[:4]) + control_crc(bytes(datagram)).to_bytes(4, "little") + bytes(datagram[8:])


def answers(server: ServerLink, now_ns: int = T0) -> list[tuple[Message, Address]]:
    """What the server sends beside clock requests."""
    messages = []
    for datagram, address in server.datagrams_to_send(now_ns):
        prefix = parse_prefix(datagram)
        assert prefix is not None
        if prefix.type != MessageType.CLOCK_REQUEST:
            messages.append((decode_message(prefix, datagram), address))
    return messages


def the_answer(server: ServerLink, now_ns: int = T0) -> Message:
    [(message, _)] = answers(server, now_ns)
    return message


def joined(
    server: ServerLink, hello: Hello | None = None, seed: int = 2, address: Address = AGENT
) -> AgentLink:
    """A connected agent, its clock known; the event of its joining is taken."""
    agent = make_agent(hello, seed)
    roundtrip(agent, server, address)
    assert agent.connected
    events_of(server)
    return agent


def session_id(agent: AgentLink) -> int:
    assert agent.session is not None
    return agent.session.session_id


def deliver(server: ServerLink, agent: AgentLink, now_ns: int = T0, **changes: Any) -> None:
    batch = agent.send_frame(make_frame(timestamp_ns=now_ns, **changes), now_ns)
    assert batch is not None
    server.receive_batch(batch, AGENT, now_ns)


# ---- welcome


def test_a_camera_is_welcomed_with_the_first_common_codec_of_its_order() -> None:
    server = make_server(color_codecs=(1, 2, 3), depth_codecs=(9, 5))
    hello = make_hello(color_codecs=(7, 3, 1), depth_codecs=(5, 9))
    server.receive_datagram(encode_message(hello, 1), AGENT, T0)
    welcome = the_answer(server)
    assert isinstance(welcome, Welcome)
    assert (welcome.camera_id, welcome.color_codec, welcome.depth_codec) == (0, 3, 5)
    [event] = events_of(server)
    assert isinstance(event, CameraJoined)
    assert (event.camera_id, event.hello.name, event.address) == (0, "cam00", AGENT)


def test_a_stream_that_is_not_offered_is_not_chosen() -> None:
    server = make_server()
    server.receive_datagram(encode_message(make_hello(color_codecs=()), 1), AGENT, T0)
    welcome = the_answer(server)
    assert isinstance(welcome, Welcome)
    assert (welcome.color_codec, welcome.depth_codec) == (None, DEPTH)


def test_a_repeated_hello_gets_the_same_welcome_and_no_new_session() -> None:
    server = make_server()
    server.receive_datagram(HELLO, AGENT, T0)
    first = the_answer(server)
    server.receive_datagram(HELLO, AGENT, T0 + 100)
    assert the_answer(server) == first
    assert [type(event) for event in events_of(server)] == [CameraJoined]


def test_a_late_copy_of_an_old_hello_does_not_end_the_session() -> None:
    server = make_server()
    server.receive_datagram(HELLO, AGENT, T0)
    server.receive_datagram(encode_message(make_hello(), 2), AGENT, T0)
    events_of(server), answers(server)
    server.receive_datagram(HELLO, AGENT, T0)
    server.receive_datagram(HELLO, OTHER, T0)
    assert (events_of(server), answers(server)) == ([], [])
    assert server.rejected == {"stale_hello": 2}


def test_session_ids_come_from_the_source_but_never_zero_or_twice() -> None:
    source = iter([0, 5, 5, 0, 6])
    server = ServerLink(Roster(open=True), lambda: next(source), (COLOR,), (DEPTH,))
    for camera_id in (0, 1):
        hello = make_hello(camera_id=camera_id, serial=f"S{camera_id}")
        server.receive_datagram(encode_message(hello, 1), (AGENT[0], camera_id), T0)
    welcomes = [message.session_id for message, _ in answers(server) if isinstance(message, Welcome)]
    assert welcomes == [5, 6]


def test_a_restarted_agent_replaces_its_session_at_once() -> None:
    server = make_server()
    old = joined(server)
    new = make_agent(seed=3)
    roundtrip(new, server, OTHER)  # same serial, another port
    assert [type(event) for event in events_of(server)] == [CameraLeft, CameraJoined]
    server.receive_datagram(encode_message(Heartbeat({}), session_id(old)), AGENT, T0)
    assert isinstance(the_answer(server), UnknownSession)
    assert server.cameras[0].address == OTHER


# ---- refusals


def test_a_hello_of_another_version_is_answered_readably_in_all_versions() -> None:
    server = make_server()
    later = bytearray(pack_prefix(MessageType.HELLO, 0, 1234) + bytes(600))  # a body that we cannot read
    later[2] = 7
    server.receive_datagram(with_crc(later), AGENT, T0)
    [(datagram, address)] = server.datagrams_to_send(T0)
    assert address == AGENT
    assert (datagram[:4], datagram[8:16]) == (b"KR\x01\x03", (1234).to_bytes(8, "little"))
    assert tuple(datagram[16:20]) == (RejectReason.VERSION_MISMATCH.value, 1, 1, 0)
    text = datagram[20:].decode()
    assert "the agent speaks protocol version 7, this server speaks 1" in text
    assert events_of(server) == [HelloRefused(AGENT, RejectReason.VERSION_MISMATCH, text)]
    assert server.rejected == {"refused_version_mismatch": 1}


@pytest.mark.parametrize(
    ("hello", "reason", "words"),
    [
        (make_hello(camera_id=5), RejectReason.UNKNOWN_CAMERA, "id 5"),
        (make_hello(camera_id=1), RejectReason.UNKNOWN_CAMERA, "is for serial S1"),
        (
            make_hello(depth_codecs=(77,)),
            RejectReason.NO_COMMON_CODEC,
            "depth codecs 77, this server",
        ),
    ],
)
def test_a_refusal_tells_both_sides_why(hello: Hello, reason: RejectReason, words: str) -> None:
    server = make_server(Roster((Slot(0, "front"), Slot(1, "left", serial="S1"))))
    server.receive_datagram(encode_message(hello, 1), AGENT, T0)
    reject = the_answer(server)
    assert isinstance(reject, Reject)
    assert reject.reason is reason
    assert words in reject.text
    assert events_of(server) == [HelloRefused(AGENT, reason, reject.text)]
    assert server.rejected == {f"refused_{reason.name.lower()}": 1}
    assert server.cameras == {}


def test_a_second_camera_on_a_live_slot_is_told_who_holds_it() -> None:
    server = make_server()
    joined(server)
    hello = encode_message(make_hello(serial="S2"), 1)
    server.receive_datagram(hello, OTHER, T0 + 700_000_000)
    reject = the_answer(server)
    assert isinstance(reject, Reject)
    assert reject.reason is RejectReason.DUPLICATE_SLOT
    assert "serial A00362A01234047A" in reject.text
    assert "192.0.2.1:40001" in reject.text
    server.receive_datagram(hello, OTHER, T0 + 750_000_000)
    assert isinstance(the_answer(server), Welcome)


def test_a_malformed_hello_is_answered_with_what_is_wrong() -> None:
    server = make_server()
    values = {**msgpack.unpackb(HELLO[16:]), "fps": "fast"}
    datagram = with_crc(pack_prefix(MessageType.HELLO, 0, 1) + msgpack.packb(values))
    server.receive_datagram(datagram, AGENT, T0)
    reject = the_answer(server)
    assert isinstance(reject, Reject)
    assert (reject.reason, "fps" in reject.text) == (RejectReason.MALFORMED, True)


def test_refusals_are_reported_once_a_second_and_address_but_always_answered() -> None:
    server = make_server(Roster())
    for k in range(20):
        server.receive_datagram(HELLO, AGENT, T0 + k * SECOND_NS // 10)
    assert len(answers(server)) == 20
    assert len(events_of(server)) == 2


def test_no_answer_to_a_stranger_is_longer_than_what_it_sent() -> None:
    server = make_server(Roster((Slot(0, "n" * 300, serial="s" * 300),)))
    text = "n" * 64
    longest = encode_message(make_hello(name=text, serial=text, port_path=text), 1)
    for datagram in (longest, encode_message(Goodbye(""), 9), encode_message(UnknownSession(), 9), HELLO):
        server.receive_datagram(datagram, AGENT, T0)
        for answer, _ in server.datagrams_to_send(T0):
            assert len(answer) <= min(len(datagram), MIN_HELLO_SIZE)


# ---- sessions


def test_an_unknown_session_is_answered_ten_times_a_second_at_most() -> None:
    server = make_server()
    datagram = encode_message(Heartbeat({}), 99)
    for k in range(1000):
        server.receive_datagram(datagram, AGENT, T0 + k * 1_000_000)
    notices = server.datagrams_to_send(T0)
    assert len(notices) == 10
    assert notices[0] == (encode_message(UnknownSession(), 99), AGENT)
    assert len(notices[0][0]) == 16
    assert server.rejected == {"unknown_session": 1000}


def test_strangers_together_get_two_hundred_notices_a_second_at_most() -> None:
    server = make_server()
    datagram = encode_message(Heartbeat({}), 99)
    for k in range(10_000):
        server.receive_datagram(datagram, ("198.51.100.1", k), T0 + k * 100_000)
    assert len(server.datagrams_to_send(T0)) == 200


def test_a_session_is_bound_to_its_address() -> None:
    server = make_server()
    agent = joined(server)
    server.receive_datagram(encode_message(Goodbye(""), session_id(agent)), OTHER, T0)
    assert server.cameras[0].connected
    assert server.rejected == {"wrong_address": 1}
    assert answers(server) == []


def test_a_silent_agent_leaves_after_two_seconds() -> None:
    server = make_server()
    agent = joined(server)
    server.receive_datagram(encode_message(Heartbeat({}), session_id(agent)), AGENT, T0 + SECOND_NS)
    server.handle_timeout(T0 + 3 * SECOND_NS - 1)
    assert events_of(server) == []
    server.handle_timeout(T0 + 3 * SECOND_NS)
    assert events_of(server) == [CameraLeft(0, "silent for 2.0 s")]
    assert not server.cameras[0].connected
    assert server.next_timeout_ns() is None


def test_a_goodbye_ends_the_session_with_its_text() -> None:
    server = make_server()
    agent = joined(server)
    server.receive_datagram(encode_message(Goodbye("device lost"), session_id(agent)), AGENT, T0)
    assert events_of(server) == [CameraLeft(0, "goodbye: device lost")]


def test_closing_says_goodbye_to_all_and_welcomes_nobody_after() -> None:
    server = make_server()
    agent = joined(server)
    server.close(T0)
    assert answers(server) == [(Goodbye("the server stops"), AGENT)]
    server.receive_datagram(encode_message(make_hello(), 9), AGENT, T0)
    assert answers(server) == []
    assert agent.connected  # until it hears the goodbye
    assert server.rejected == {"closed": 1}


def test_health_reaches_the_status() -> None:
    server = make_server()
    agent = joined(server)
    server.receive_datagram(encode_message(Heartbeat({"temperature_c": 60.0}), session_id(agent)), AGENT, T0)
    assert server.cameras[0].health == {"temperature_c": 60.0}


def test_an_unnamed_camera_of_an_open_roster_gets_its_old_id_back() -> None:
    server = make_server()
    joined(server, make_hello(camera_id=None, serial="S0"), seed=10, address=("192.0.2.9", 1))
    agent = joined(server, make_hello(camera_id=None, serial="S1"), seed=11, address=("192.0.2.9", 2))
    assert agent.session is not None
    assert agent.session.camera_id == 1
    again = joined(server, make_hello(camera_id=None, serial="S1"), seed=12, address=("192.0.2.9", 3))
    assert again.session is not None
    assert again.session.camera_id == 1


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


def test_a_frame_before_the_first_clock_exchange_is_untimed() -> None:
    server, agent = make_server(), make_agent()
    [hello] = agent.datagrams_to_send(T0)
    server.receive_datagram(hello, AGENT, T0)
    agent.receive_datagram(server.datagrams_to_send(T0)[0][0], T0)
    deliver(server, agent)
    assert [type(event) for event in events_of(server)] == [CameraJoined]
    assert server.cameras[0].counters.untimed == 1


@pytest.mark.parametrize("stamp_ns", [T0 + SECOND_NS, T0 - 11 * SECOND_NS, -(2**63), 2**63 - 1])
def test_a_frame_from_the_future_or_long_ago_is_untimed_and_the_clock_is_asked_soon(
    stamp_ns: int,
) -> None:
    server = make_server()
    agent = joined(server)
    server.datagrams_to_send(T0 + SECOND_NS // 2)
    batch = agent.send_frame(make_frame(timestamp_ns=stamp_ns), T0)
    assert batch is not None
    server.receive_batch(batch, AGENT, T0)
    assert events_of(server) == []
    assert server.cameras[0].counters.untimed == 1
    assert server.datagrams_to_send(T0 + SECOND_NS // 2 + 20_000_000) != []


def test_a_damaged_frame_is_delivered_flagged_and_counted() -> None:
    server = make_server()
    deliver(server, joined(server), damaged=True)
    [event] = events_of(server)
    assert event.frame.damaged
    assert server.cameras[0].counters.damaged == 1


def test_a_frame_in_a_codec_that_was_not_chosen_is_refused() -> None:
    server = make_server(color_codecs=(COLOR, COLOR + 1))
    agent = joined(server)
    assert agent.session is not None
    object.__setattr__(agent.session, "color_codec", COLOR + 1)  # an agent that does not keep to the welcome
    deliver(server, agent, color=Payload(COLOR + 1, b"x"))
    assert events_of(server) == []
    assert server.cameras[0].counters.unexpected_codec == 1


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
    batch = agent.send_frame(make_frame(timestamp_ns=T0, size=1408), T0)
    assert batch is not None
    heartbeat = encode_message(Heartbeat({"t": 1.0}), session_id(agent)).ljust(1472, b"\0")
    content = heartbeat + bytes(batch.buffer) + b"\xff" * 1472 + b"KR"
    server.receive_batch(DatagramBatch(content, 1472), AGENT, T0)
    assert [type(event) for event in events_of(server)] == [FrameReceived]
    assert server.rejected == {"corrupt_control": 1, "bad_magic": 1, "too_short": 1}


@pytest.mark.parametrize(
    ("datagram", "cause"),
    [
        (b"", "too_short"),
        (bytes(15), "too_short"),
        (bytes(16), "bad_magic"),
        (MAGIC + bytes((2, MessageType.FRAGMENT)) + bytes(60), "other_version"),
        (MAGIC + bytes((1, 99)) + bytes(12), "unknown_type"),
        (encode_message(ClockRequest(1), 5), "unexpected_type"),
        (encode_message(Reject(RejectReason.OTHER, "x"), 5), "unexpected_type"),
        (encode_message(Goodbye("x"), 5)[:-1], "corrupt_control"),
        (HELLO[:-1], "corrupt_control"),
        (HELLO[:511], "malformed"),
        (encode_message(make_hello(), 0), "malformed"),
        (MAGIC + bytes((1, MessageType.FRAGMENT)) + bytes(12), "bad_fragment"),
        (MAGIC + bytes((1, MessageType.FRAGMENT)) + bytes(60), "bad_fragment"),
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
    agent = joined(server)
    server.receive_datagram(
        with_crc(pack_prefix(MessageType.HEARTBEAT, 0, session_id(agent)) + body), AGENT, T0
    )
    assert server.rejected == {"malformed": 1}


def test_a_clock_reply_without_its_request_is_counted() -> None:
    server = make_server()
    agent = joined(server)
    server.receive_datagram(encode_message(ClockReply(1, 2, 3), session_id(agent)), AGENT, T0)
    assert server.cameras[0].counters.bad_clock_reply == 1


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_datagrams_may_be_any_bytes_like_object(kind: type) -> None:
    server = make_server()
    datagram: Buffer = kind(HELLO)
    server.receive_datagram(datagram, AGENT, T0)
    assert isinstance(the_answer(server), Welcome)


@pytest.mark.parametrize("size", [1199, 65508])
def test_a_datagram_size_out_of_range_is_misuse(size: int) -> None:
    with pytest.raises(LinkUsageError):
        make_server(datagram_size=size)
