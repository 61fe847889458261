import pytest

from rig_protocol.agent_link import (
    HEARTBEAT_INTERVAL_NS,
    HELLO_RETRY_NS,
    REFUSED_RETRY_NS,
    SILENCE_NS,
    AgentLink,
)
from rig_protocol.datagram import MAGIC, MessageType, parse_prefix
from rig_protocol.errors import LinkUsageError
from rig_protocol.events import Connected, Disconnected, Rejected
from rig_protocol.frames import Payload
from rig_protocol.message_bytes import control_crc, decode_message, encode_message
from rig_protocol.messages import (
    ClockReply,
    ClockRequest,
    Goodbye,
    Heartbeat,
    Message,
    Reject,
    RejectReason,
    UnknownSession,
    Welcome,
)
from support.wire import (
    AGENT,
    COLOR,
    DEPTH,
    T0,
    events_of,
    make_agent,
    make_frame,
    make_hello,
    make_server,
    roundtrip,
)

WELCOME = Welcome(session_id=77, camera_id=4, color_codec=COLOR, depth_codec=DEPTH, datagram_size=1472)


def sent(agent: AgentLink, now_ns: int) -> list[tuple[int, Message]]:
    """Id and content of what the agent sends."""
    messages = []
    for datagram in agent.datagrams_to_send(now_ns):
        prefix = parse_prefix(datagram)
        assert prefix is not None
        messages.append((prefix.id, decode_message(prefix, datagram)))
    return messages


def nonce_of(agent: AgentLink, now_ns: int = T0) -> int:
    [(nonce, _)] = sent(agent, now_ns)
    return nonce


def connected(now_ns: int = T0) -> AgentLink:
    agent = make_agent()
    agent.receive_datagram(encode_message(WELCOME, nonce_of(agent, now_ns)), now_ns)
    assert events_of(agent) == [Connected(WELCOME)]
    return agent


def test_hello_is_repeated_with_one_nonce_and_doubling_waits() -> None:
    agent, now_ns, nonces, waits = make_agent(), T0, set(), []
    for _ in range(7):
        nonces.add(nonce_of(agent, now_ns))
        due_ns = agent.next_timeout_ns()
        assert due_ns is not None
        assert agent.datagrams_to_send(due_ns - 1) == []
        waits.append(due_ns - now_ns)
        now_ns = due_ns
    assert len(nonces) == 1
    assert waits == [100_000_000, 200_000_000, 400_000_000, 800_000_000, *[HELLO_RETRY_NS[1]] * 3]


def test_a_welcome_connects() -> None:
    agent = connected()
    assert agent.connected
    assert agent.session == WELCOME


def test_an_answer_to_another_hello_is_stale() -> None:
    agent = make_agent()
    nonce = nonce_of(agent)
    agent.receive_datagram(encode_message(WELCOME, nonce ^ 1), T0)
    agent.receive_datagram(encode_message(Reject(RejectReason.MALFORMED, "no"), nonce ^ 1), T0)
    assert not agent.connected
    assert events_of(agent) == []
    assert agent.counters.rejected == {"stale_answer": 2}


def test_a_second_welcome_changes_nothing() -> None:
    agent = make_agent()
    welcome = encode_message(WELCOME, nonce_of(agent))
    agent.receive_datagram(welcome, T0)
    agent.receive_datagram(welcome, T0)
    assert agent.counters.sessions == 1
    assert agent.counters.rejected == {"stale_answer": 1}


def test_a_reject_is_told_and_the_next_hellos_wait_longer_and_longer() -> None:
    agent, now_ns, waits = make_agent(), T0, []
    for _ in range(6):
        nonce = nonce_of(agent, now_ns)
        agent.receive_datagram(encode_message(Reject(RejectReason.DUPLICATE_SLOT, "held"), nonce), now_ns)
        assert events_of(agent) == [Rejected(RejectReason.DUPLICATE_SLOT, "held")]
        due_ns = agent.next_timeout_ns()
        assert due_ns is not None
        waits.append((due_ns - now_ns) // 1_000_000)
        now_ns = due_ns
    assert waits == [500, 1000, 2000, 4000, REFUSED_RETRY_NS[1] // 1_000_000, 5000]


def test_a_reject_of_another_version_is_read() -> None:
    agent = make_agent()
    datagram = bytearray(
        encode_message(Reject(RejectReason.VERSION_MISMATCH, "2 only", 2, 2), nonce_of(agent))
    )
    datagram[2] = 2
    datagram[4:8] = control_crc(bytes(datagram)).to_bytes(4, "little")
    agent.receive_datagram(bytes(datagram), T0)
    assert events_of(agent) == [Rejected(RejectReason.VERSION_MISMATCH, "2 only")]


def test_heartbeats_carry_the_health_twice_a_second() -> None:
    agent = connected()
    agent.report_health({"temperature_c": 55.0})
    assert sent(agent, T0) == [(77, Heartbeat({"temperature_c": 55.0}))]
    assert sent(agent, T0 + HEARTBEAT_INTERVAL_NS - 1) == []
    assert len(sent(agent, T0 + HEARTBEAT_INTERVAL_NS)) == 1


def test_health_against_the_limits_is_misuse() -> None:
    with pytest.raises(LinkUsageError):
        connected().report_health({"t": float("nan")})


def test_a_clock_request_is_answered_with_reading_and_sending_time() -> None:
    agent = connected()
    sent(agent, T0)
    agent.receive_datagram(encode_message(ClockRequest(123), 77), T0 + 5)
    assert sent(agent, T0 + 9) == [(77, ClockReply(123, T0 + 5, T0 + 9))]


def test_clock_requests_that_wait_are_bounded() -> None:
    agent = connected()
    for t1_ns in range(100):
        agent.receive_datagram(encode_message(ClockRequest(t1_ns), 77), T0)
    replies = [message for _, message in sent(agent, T0) if isinstance(message, ClockReply)]
    assert [reply.t1_ns for reply in replies] == list(range(84, 100))


def test_silence_of_the_server_ends_the_session() -> None:
    agent = connected()
    agent.receive_datagram(encode_message(ClockRequest(1), 77), T0 + 1000)
    agent.handle_timeout(T0 + SILENCE_NS)
    assert agent.connected
    agent.handle_timeout(T0 + 1000 + SILENCE_NS)
    assert events_of(agent) == [Disconnected("the server has been silent for 2.0 s")]
    assert agent.next_timeout_ns() == T0 + 1000 + SILENCE_NS  # hello at once


@pytest.mark.parametrize("message", [UnknownSession(), Goodbye("the server stops")])
def test_goodbye_and_unknown_session_end_the_session_and_hello_follows_at_once(
    message: Message,
) -> None:
    agent = connected()
    agent.receive_datagram(encode_message(message, 78), T0)
    assert agent.connected
    agent.receive_datagram(encode_message(message, 77), T0)
    [event] = events_of(agent)
    assert isinstance(event, Disconnected)
    first = parse_prefix(make_agent().datagrams_to_send(T0)[0])
    assert first is not None
    assert nonce_of(agent, T0) != first.id  # a new session takes a new nonce


def test_frames_before_the_welcome_are_counted_not_sent() -> None:
    agent = make_agent()
    assert agent.send_frame(make_frame(), T0) is None
    assert agent.counters.not_connected == 1


def test_frames_are_numbered_from_zero_in_every_session() -> None:
    server, agent = make_server(), make_agent()
    for _ in range(2):
        roundtrip(agent, server)
        for number in range(3):
            batch = agent.send_frame(make_frame(100 + number), T0)
            assert batch is not None
            assert int.from_bytes(batch[0][16:24], "little") == number
        assert agent.session is not None
        agent.receive_datagram(encode_message(Goodbye(""), agent.session.session_id), T0)


def test_a_frame_encoded_for_another_choice_is_counted_not_sent() -> None:
    agent = connected()
    assert agent.send_frame(make_frame(color=Payload(COLOR + 1, b"x")), T0) is None
    assert agent.counters.unexpected_codec == 1


@pytest.mark.parametrize(("own", "servers"), [(1472, 1300), (1300, 1472)])
def test_fragments_keep_to_the_smaller_datagram_size(own: int, servers: int) -> None:
    agent, server = make_agent(datagram_size=own), make_server(datagram_size=servers)
    roundtrip(agent, server)
    batch = agent.send_frame(make_frame(), T0)
    assert batch is not None
    assert batch.segment_size == 1300


@pytest.mark.parametrize("size", [1199, 65508])
def test_a_datagram_size_out_of_range_is_misuse(size: int) -> None:
    with pytest.raises(LinkUsageError):
        make_agent(datagram_size=size)


def test_a_hello_that_cannot_be_sent_is_misuse_at_once() -> None:
    with pytest.raises(LinkUsageError, match="name"):
        make_agent(make_hello(name="x" * 65))


def test_closing_says_goodbye_once_and_then_nothing() -> None:
    agent = connected()
    agent.close(T0)
    assert sent(agent, T0) == [(77, Goodbye("the agent stops"))]
    assert agent.datagrams_to_send(T0 + 10**10) == []
    assert agent.next_timeout_ns() is None
    assert agent.send_frame(make_frame(), T0) is None
    agent.receive_datagram(encode_message(ClockRequest(1), 77), T0)
    assert agent.counters.rejected == {"unknown_session": 1}


@pytest.mark.parametrize(
    ("datagram", "cause"),
    [
        (b"", "too_short"),
        (bytes(15), "too_short"),
        (bytes(16), "bad_magic"),
        (MAGIC + bytes((2, MessageType.WELCOME)) + bytes(12), "other_version"),
        (MAGIC + bytes((1, 99)) + bytes(12), "unknown_type"),
        (encode_message(Heartbeat({}), 77), "unexpected_type"),
        (MAGIC + bytes((1, MessageType.FRAGMENT)) + bytes(40), "unexpected_type"),
        (encode_message(Goodbye("x"), 77)[:-1], "corrupt_control"),
        (encode_message(ClockRequest(5), 78), "unknown_session"),
    ],
)
def test_an_unexpected_datagram_is_dropped_and_counted_by_cause(datagram: bytes, cause: str) -> None:
    agent = connected()
    agent.receive_datagram(datagram, T0)
    assert agent.counters.rejected == {cause: 1}
    assert agent.connected
    assert events_of(agent) == []


def test_a_clock_that_jumped_back_does_not_hold_up_the_hello() -> None:
    agent = make_agent()
    nonce_of(agent, T0)
    assert len(agent.datagrams_to_send(T0 - 3_600 * 10**9)) == 1


def test_an_agent_at_the_server_gets_its_slot() -> None:
    server, agent = make_server(), make_agent(make_hello(camera_id=None))
    roundtrip(agent, server, AGENT)
    assert agent.session is not None
    assert agent.session.camera_id == 0
