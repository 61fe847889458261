import pytest

from rig_protocol.agent_link import (
    DOUBT_NS,
    HEARTBEAT_INTERVAL_NS,
    HELLO_RETRY_NS,
    REFUSED_RETRY_NS,
    SILENCE_NS,
    AgentLink,
)
from rig_protocol.agent_session import CONFIRM_INTERVAL_NS
from rig_protocol.clear_datagram import clear_crc, encode_clear
from rig_protocol.datagram import MAGIC, MessageType
from rig_protocol.errors import LinkUsageError
from rig_protocol.events import Connected, Disconnected, Rejected
from rig_protocol.frames import Payload
from rig_protocol.gravity import Gravity
from rig_protocol.message_bytes import encode_body
from rig_protocol.messages import (
    WHOLE_FRAME,
    ClockReply,
    ClockRequest,
    Goodbye,
    Heartbeat,
    Message,
    Reject,
    RejectReason,
    Resend,
    StreamPlan,
    UnknownSession,
)
from rig_protocol.rig_key import RigKey
from rig_protocol.system_clock import SystemClockReading
from support.peers import WELCOME, ServerPeer, id_of
from support.wire import (
    AGENT,
    COLOR,
    DEPTH,
    SECOND_NS,
    T0,
    events_of,
    make_agent,
    make_frame,
    make_hello,
    make_server,
    roundtrip,
)

PLAN = StreamPlan(COLOR, None, 15.0, 1_000_000, 250_000, 0.8, -5)


def the_hello(agent: AgentLink, now_ns: int = T0) -> bytes:
    [hello] = agent.datagrams_to_send(now_ns)
    return hello


def clear(message: Message, id_: int) -> bytes:
    return encode_clear(*encode_body(message), id_)


def welcomed(now_ns: int = T0) -> tuple[AgentLink, ServerPeer]:
    """An agent that has a welcome, and has heard nothing else of its server."""
    agent, server = make_agent(), ServerPeer()
    agent.receive_datagram(server.welcome(the_hello(agent, now_ns)), now_ns)
    return agent, server


def connected(now_ns: int = T0) -> tuple[AgentLink, ServerPeer]:
    agent, server = welcomed(now_ns)
    agent.receive_datagram(server.seal(ClockRequest(0)), now_ns)
    assert events_of(agent) == [Connected(WELCOME)]
    server.read(agent.datagrams_to_send(now_ns))
    return agent, server


def sent(agent: AgentLink, server: ServerPeer, now_ns: int) -> list[Message]:
    """What the agent says in its session."""
    return server.read(agent.datagrams_to_send(now_ns))


def test_hello_is_repeated_with_one_nonce_and_doubling_waits() -> None:
    agent, now_ns, nonces, waits = make_agent(), T0, set(), []
    for _ in range(7):
        nonces.add(id_of(the_hello(agent, now_ns)))
        due_ns = agent.next_timeout_ns()
        assert due_ns is not None
        assert agent.datagrams_to_send(due_ns - 1) == []
        waits.append(due_ns - now_ns)
        now_ns = due_ns
    assert len(nonces) == 1
    assert waits == [100_000_000, 200_000_000, 400_000_000, 800_000_000, *[HELLO_RETRY_NS[1]] * 3]


def test_a_welcome_connects_once_the_server_has_spoken_under_the_sessions_keys() -> None:
    agent, server = welcomed()
    assert not agent.connected
    assert agent.send_frame(make_frame(), T0) is None
    agent.receive_datagram(server.seal(ClockRequest(5)), T0)
    assert agent.connected
    assert agent.session == WELCOME
    assert events_of(agent) == [Connected(WELCOME)]


def test_until_the_server_has_spoken_heartbeats_come_fast() -> None:
    """The first one begins the session at the server; it may be lost."""
    agent, server = welcomed()
    for k in range(5):
        assert sent(agent, server, T0 + k * CONFIRM_INTERVAL_NS) == [Heartbeat({})]
    assert sent(agent, server, T0 + 5 * CONFIRM_INTERVAL_NS - 1) == []


def test_a_welcome_after_which_the_server_is_silent_is_given_up_for_a_new_hello() -> None:
    agent, server = welcomed()
    sent(agent, server, T0)
    agent.handle_timeout(T0 + SILENCE_NS)
    assert agent.next_timeout_ns() == T0 + SILENCE_NS
    assert ServerPeer().read_hello(the_hello(agent, T0 + SILENCE_NS)).name == "cam00"
    assert events_of(agent) == []


def test_the_welcome_of_a_server_without_the_key_is_not_accepted_and_gets_no_frame() -> None:
    agent = make_agent()
    hello = the_hello(agent)
    impostor = ServerPeer(RigKey(bytes(32)))
    agent.receive_datagram(impostor.welcome(hello), T0)
    agent.receive_datagram(impostor.seal(ClockRequest(5)), T0)
    assert not agent.connected
    assert events_of(agent) == []
    assert agent.send_frame(make_frame(), T0) is None
    assert agent.counters.rejected == {"bad_seal": 1, "unknown_session": 1}
    agent.receive_datagram(ServerPeer().welcome(hello), T0)  # the true one is still welcome
    assert [id_of(datagram) for datagram in agent.datagrams_to_send(T0)] == [WELCOME.session_id]


def test_an_answer_to_another_hello_is_stale() -> None:
    agent = make_agent()
    hello = the_hello(agent)
    agent.receive_datagram(ServerPeer().welcome(the_hello(make_agent(seed=99))), T0)
    agent.receive_datagram(clear(Reject(RejectReason.MALFORMED, "no"), id_of(hello) ^ 1), T0)
    assert not agent.connected
    assert events_of(agent) == []
    assert agent.counters.rejected == {"stale_answer": 2}


def test_a_second_welcome_changes_nothing() -> None:
    agent, server = make_agent(), ServerPeer()
    welcome = server.welcome(the_hello(agent))
    for _ in range(2):
        agent.receive_datagram(welcome, T0)
    agent.receive_datagram(server.seal(ClockRequest(5)), T0)
    agent.receive_datagram(welcome, T0)
    assert agent.counters.sessions == 1
    assert agent.counters.rejected == {"stale_answer": 2}


def test_a_reject_is_told_and_the_next_hellos_wait_longer_and_longer() -> None:
    agent, now_ns, waits = make_agent(), T0, []
    for _ in range(6):
        nonce = id_of(the_hello(agent, now_ns))
        agent.receive_datagram(clear(Reject(RejectReason.DUPLICATE_SLOT, "held"), nonce), now_ns)
        assert events_of(agent) == [Rejected(RejectReason.DUPLICATE_SLOT, "held")]
        due_ns = agent.next_timeout_ns()
        assert due_ns is not None
        waits.append((due_ns - now_ns) // 1_000_000)
        now_ns = due_ns
    assert waits == [500, 1000, 2000, 4000, REFUSED_RETRY_NS[1] // 1_000_000, 5000]


def test_one_reject_is_taken_for_each_hello_so_that_forged_ones_cannot_put_off_the_next() -> None:
    agent = make_agent()
    hello = the_hello(agent)
    for k in range(50):
        agent.receive_datagram(clear(Reject(RejectReason.OTHER, f"go {k}"), id_of(hello)), T0 + k * 9_000_000)
    assert events_of(agent) == [Rejected(RejectReason.OTHER, "go 0")]
    assert agent.counters.rejected == {"stale_answer": 49}
    assert len(agent.datagrams_to_send(T0 + REFUSED_RETRY_NS[0])) == 1


@pytest.mark.parametrize("version", [1, 3])
def test_a_reject_of_another_version_is_read(version: int) -> None:
    agent = make_agent()
    datagram = bytearray(
        clear(Reject(RejectReason.VERSION_MISMATCH, "others only", version, version), id_of(the_hello(agent)))
    )
    datagram[2] = version
    datagram[4:8] = clear_crc(datagram).to_bytes(4, "little")
    agent.receive_datagram(bytes(datagram), T0)
    assert events_of(agent) == [Rejected(RejectReason.VERSION_MISMATCH, "others only")]


def test_heartbeats_carry_the_health_twice_a_second() -> None:
    agent, server = connected()
    agent.report_health({"temperature_c": 55.0})
    due_ns = T0 + HEARTBEAT_INTERVAL_NS
    assert sent(agent, server, due_ns) == [Heartbeat({"temperature_c": 55.0})]
    assert sent(agent, server, due_ns + HEARTBEAT_INTERVAL_NS - 1) == []
    assert len(sent(agent, server, due_ns + HEARTBEAT_INTERVAL_NS)) == 1


@pytest.mark.parametrize(("left_of_the_last", "told"), [(3, 3), (2, 2), (0, 2)])
def test_a_heartbeat_tells_how_many_frames_have_left_whole(left_of_the_last: int, told: int) -> None:
    agent, server = connected()
    batches = [agent.send_frame(make_frame(k), T0) for k in range(3)]
    agent.frames_to_resend(lambda batch: left_of_the_last if batch is batches[-1] else len(batch))
    assert sent(agent, server, T0 + HEARTBEAT_INTERVAL_NS) == [Heartbeat({}, told)]


def test_heartbeats_tell_gravity_at_once_when_it_is_felt_and_when_it_is_not_any_more() -> None:
    agent, server = connected()
    agent.gravity = Gravity((0.0, 1.0, 0.0))
    assert sent(agent, server, T0 + 1) == [Heartbeat({}, gravity=agent.gravity)]
    agent.gravity = Gravity((0.0, 0.0, 1.0))
    assert sent(agent, server, T0 + 2) == []
    assert sent(agent, server, T0 + 1 + HEARTBEAT_INTERVAL_NS) == [Heartbeat({}, gravity=agent.gravity)]
    agent.gravity = None
    assert sent(agent, server, T0 + 2 + HEARTBEAT_INTERVAL_NS) == [Heartbeat({})]


def test_health_against_the_limits_is_misuse() -> None:
    with pytest.raises(LinkUsageError):
        connected()[0].report_health({"t": float("nan")})


def test_a_clock_request_is_answered_with_reading_and_sending_time() -> None:
    agent, server = connected()
    agent.receive_datagram(server.seal(ClockRequest(123)), T0 + 5)
    assert agent.answers_clock
    assert sent(agent, server, T0 + 9) == [ClockReply(123, T0 + 5, T0 + 9)]
    assert not agent.answers_clock


def test_a_clock_reply_carries_what_the_system_clock_is_worth() -> None:
    agent, server = connected()
    agent.receive_datagram(server.seal(ClockRequest(1)), T0)
    reading = SystemClockReading(wall_minus_monotonic_ns=10**18, error_ns=40_000)
    [reply] = server.read(agent.datagrams_to_send(T0, reading))
    assert reply == ClockReply(1, T0, T0, 10**18, 40_000)


def test_clock_requests_that_wait_are_bounded() -> None:
    agent, server = connected()
    for t1_ns in range(100):
        agent.receive_datagram(server.seal(ClockRequest(t1_ns)), T0)
    replies = [message for message in sent(agent, server, T0) if isinstance(message, ClockReply)]
    assert [reply.t1_ns for reply in replies] == list(range(84, 100))


def test_silence_of_the_server_ends_the_session() -> None:
    agent, server = connected()
    agent.receive_datagram(server.seal(ClockRequest(1)), T0 + 1000)
    agent.handle_timeout(T0 + SILENCE_NS)
    assert agent.connected
    agent.handle_timeout(T0 + 1000 + SILENCE_NS)
    assert events_of(agent) == [Disconnected("the server has been silent for 2.0 s")]
    assert agent.next_timeout_ns() == T0 + 1000 + SILENCE_NS  # hello at once


def test_only_what_is_authentic_breaks_the_silence() -> None:
    agent, server = connected()
    old = server.seal(ClockRequest(1))
    agent.receive_datagram(old, T0)
    for k in range(1, 40):
        agent.receive_datagram(old, T0 + k * 50_000_000)
        agent.receive_datagram(server.seal(ClockRequest(k))[:-1] + b"?", T0 + k * 50_000_000)
        agent.receive_datagram(clear(UnknownSession(), WELCOME.session_id), T0 + k * 50_000_000)
    agent.handle_timeout(T0 + SILENCE_NS)
    assert not agent.connected


def test_a_goodbye_ends_the_session_and_a_new_hello_follows_at_once() -> None:
    agent, server = connected()
    first = id_of(the_hello(make_agent()))
    agent.receive_datagram(server.seal(Goodbye("the server stops")), T0)
    assert events_of(agent) == [Disconnected("the server said goodbye: the server stops")]
    assert id_of(the_hello(agent)) != first


# ---- UNKNOWN_SESSION: anybody can say it


def test_a_notice_ends_no_session_and_a_live_servers_next_message_takes_all_doubt() -> None:
    agent, server = connected()
    frames = [agent.send_frame(make_frame(), T0)]
    agent.receive_datagram(clear(UnknownSession(), WELCOME.session_id), T0)
    frames.append(agent.send_frame(make_frame(), T0))
    agent.receive_datagram(server.seal(ClockRequest(1)), T0 + SECOND_NS // 4)
    frames.append(agent.send_frame(make_frame(), T0))
    said = sent(agent, server, T0 + DOUBT_NS)  # reads as the session's: no hello among it
    assert {type(message) for message in said} == {ClockReply, Heartbeat}
    assert (agent.connected, events_of(agent), None in frames) == (True, [], False)


def test_a_server_that_has_forgotten_us_is_asked_after_two_of_its_requests_did_not_come() -> None:
    agent, _ = connected()
    agent.receive_datagram(clear(UnknownSession(), WELCOME.session_id), T0 + 100_000_000)
    agent.datagrams_to_send(T0 + DOUBT_NS - 1)
    assert agent.next_timeout_ns() == T0 + DOUBT_NS
    hello = the_hello(agent, T0 + DOUBT_NS)
    restarted = ServerPeer(seed=70)
    agent.receive_datagram(restarted.welcome(hello, session_id=78), T0 + DOUBT_NS)
    agent.receive_datagram(restarted.seal(ClockRequest(0)), T0 + DOUBT_NS)
    assert [type(event) for event in events_of(agent)] == [Disconnected, Connected]
    assert agent.session is not None
    assert agent.session.session_id == 78


def test_a_notice_before_the_session_is_confirmed_leads_to_a_new_hello_at_once() -> None:
    """The server has forgotten the handshake, or has given the slot to another agent meanwhile."""
    agent, server = welcomed()
    sent(agent, server, T0)
    agent.receive_datagram(clear(UnknownSession(), WELCOME.session_id), T0)
    assert ServerPeer().read_hello(the_hello(agent, T0)).name == "cam00"


@pytest.mark.parametrize("harm", [lambda d: d + b"x", lambda d: d[:-1] + b"?"])
def test_a_notice_of_another_shape_or_session_is_dropped(harm: object) -> None:
    agent, _ = connected()
    notice = clear(UnknownSession(), WELCOME.session_id)
    agent.receive_datagram(harm(notice), T0)  # type: ignore[operator]
    agent.receive_datagram(clear(UnknownSession(), WELCOME.session_id + 1), T0)
    assert agent.next_timeout_ns() == T0 + HEARTBEAT_INTERVAL_NS  # no hello waits
    assert sum(agent.counters.rejected.values()) == 2


# ---- frames


def test_frames_before_the_welcome_are_counted_not_sent() -> None:
    agent = make_agent()
    assert agent.send_frame(make_frame(), T0) is None
    assert agent.counters.not_connected == 1


def test_frames_are_numbered_from_zero_in_every_session() -> None:
    agent = make_agent()
    for _ in range(2):
        server = ServerPeer()
        agent.receive_datagram(server.welcome(the_hello(agent)), T0)
        agent.receive_datagram(server.seal(ClockRequest(0)), T0)
        for number in range(3):
            batch = agent.send_frame(make_frame(100 + number), T0)
            assert batch is not None
            assert int.from_bytes(batch[0][16:24], "little") == number
        agent.receive_datagram(server.seal(Goodbye("")), T0)


def test_a_frame_in_a_codec_that_the_server_does_not_take_is_counted_not_sent() -> None:
    agent, _ = connected()
    assert agent.send_frame(make_frame(color=Payload(COLOR + 1, b"x")), T0) is None
    assert agent.counters.unexpected_codec == 1


def test_frames_may_change_between_all_codecs_that_the_server_takes() -> None:
    agent, server = make_agent(), ServerPeer()
    agent.receive_datagram(server.welcome(the_hello(agent), color_codecs=(COLOR, COLOR + 1)), T0)
    agent.receive_datagram(server.seal(ClockRequest(0)), T0)
    for codec_id in (COLOR, COLOR + 1, COLOR):
        assert agent.send_frame(make_frame(color=Payload(codec_id, b"x")), T0) is not None


def test_a_plan_holds_until_the_next_one_or_the_end_of_the_session() -> None:
    agent, server = connected()
    assert agent.plan is None
    agent.receive_datagram(server.seal(PLAN), T0)
    assert agent.plan == PLAN
    agent.receive_datagram(server.seal(Goodbye("")), T0)
    assert agent.plan is None


# ---- resends


def test_what_the_server_missed_is_sent_again_as_it_was() -> None:
    agent, server = connected()
    batch = agent.send_frame(make_frame(size=8000), T0)
    assert batch is not None
    agent.receive_datagram(server.seal(Resend(0, ((1, 2), (5, 1)))), T0)
    again = [bytes(datagram) for one in agent.frames_to_resend(len) for datagram in one]
    assert again == [bytes(batch[k]) for k in (1, 2, 5)]
    assert agent.frames_to_resend(len) == []
    assert agent.counters.resent == 3


def test_a_frame_that_was_given_up_is_not_sent_again() -> None:
    agent, server = connected()
    batches = [agent.send_frame(make_frame(), T0) for _ in range(2)]
    assert batches[0] is not None
    agent.give_up_frame(batches[0])
    agent.receive_datagram(server.seal(Resend(0, WHOLE_FRAME)), T0)
    assert agent.frames_to_resend(len) == []
    assert agent.counters.resend_refused == 1


def test_requests_that_wait_are_bounded_and_the_oldest_give_way() -> None:
    agent, server = connected()
    agent.send_frame(make_frame(size=100_000), T0)
    for k in range(40):
        agent.receive_datagram(server.seal(Resend(0, ((k, 1),))), T0)
    again = [int.from_bytes(one[0][30:32], "little") for one in agent.frames_to_resend(len)]
    assert again == list(range(8, 40))


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
    agent, server = connected()
    agent.close(T0)
    assert sent(agent, server, T0) == [Heartbeat({}), Goodbye("the agent stops")]
    assert agent.datagrams_to_send(T0 + 10**10) == []
    assert agent.next_timeout_ns() is None
    assert agent.send_frame(make_frame(), T0) is None
    agent.receive_datagram(server.seal(ClockRequest(1)), T0)
    assert agent.counters.rejected == {"unknown_session": 1}


@pytest.mark.parametrize(
    ("datagram", "cause"),
    [
        (b"", "too_short"),
        (bytes(15), "too_short"),
        (bytes(16), "bad_magic"),
        (MAGIC + bytes((1, MessageType.WELCOME)) + bytes(12), "other_version"),
        (MAGIC + bytes((2, 99)) + bytes(12), "unknown_type"),
        (MAGIC + bytes((2, MessageType.HEARTBEAT)) + bytes(40), "unexpected_type"),
        (MAGIC + bytes((2, MessageType.FRAGMENT)) + bytes(40), "unexpected_type"),
        (MAGIC + bytes((2, MessageType.GOODBYE)) + bytes(4) + bytes([77]) + bytes(7 + 1200), "malformed"),
        (MAGIC + bytes((2, MessageType.GOODBYE)) + bytes(4) + bytes([77]) + bytes(7 + 23), "malformed"),
        (MAGIC + bytes((2, MessageType.GOODBYE)) + bytes(4) + bytes([77]) + bytes(7 + 24), "replayed"),
        (
            MAGIC + bytes((2, MessageType.GOODBYE)) + bytes(4) + bytes([77]) + bytes(7) + b"\5" * 24,
            "bad_seal",
        ),
        (
            MAGIC + bytes((2, MessageType.CLOCK_REQUEST)) + bytes(4) + bytes([78]) + bytes(40),
            "unknown_session",
        ),
        (clear(Reject(RejectReason.OTHER, "x"), 5), "stale_answer"),
        (clear(Reject(RejectReason.OTHER, "x"), 5)[:-1], "corrupt_control"),
    ],
)
def test_an_unexpected_datagram_is_dropped_and_counted_by_cause(datagram: bytes, cause: str) -> None:
    agent, _ = connected()
    agent.receive_datagram(datagram, T0)
    assert agent.counters.rejected == {cause: 1}
    assert agent.connected
    assert events_of(agent) == []


def test_an_authentic_message_of_a_shape_that_we_do_not_know_is_malformed() -> None:
    agent, server = connected()
    agent.receive_datagram(server.seal_body(MessageType.PLAN, b"\x80"), T0)
    assert agent.counters.rejected == {"malformed": 1}


def test_a_clock_that_jumped_back_does_not_hold_up_the_hello() -> None:
    agent = make_agent()
    the_hello(agent, T0)
    assert len(agent.datagrams_to_send(T0 - 3_600 * 10**9)) == 1


def test_an_agent_at_the_server_gets_its_slot() -> None:
    server, agent = make_server(), make_agent(make_hello(camera_id=None))
    roundtrip(agent, server, AGENT)
    assert agent.session is not None
    assert agent.session.camera_id == 0
    assert (agent.session.color_codecs, agent.session.depth_codecs) == ((COLOR,), (DEPTH,))
