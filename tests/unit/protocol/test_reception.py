"""The server towards those who have no session: hellos, refusals, notices."""

import zlib

import msgpack
import pytest

from rig_protocol.datagram import MessageType, pack_prefix
from rig_protocol.events import CameraJoined, CameraLeft, FrameReceived, HelloRefused
from rig_protocol.message_bytes import MIN_HELLO_SIZE, encode_body
from rig_protocol.messages import (
    ClockRequest,
    Heartbeat,
    Hello,
    Reject,
    RejectReason,
    UnknownSession,
)
from rig_protocol.pending_sessions import MAX_PENDING
from rig_protocol.rig_key import RigKey
from rig_protocol.roster import Roster, Slot
from rig_protocol.security import Cipher
from support.peers import AgentPeer
from support.server_sessions import (
    HELLO,
    STEP_NS,
    clear,
    deliver,
    joined,
    joined_peer,
    sealed_hello,
    the_answer,
    welcomed,
    with_crc,
)
from support.wire import (
    AGENT,
    DEPTH,
    KEY,
    OTHER,
    SECOND_NS,
    T0,
    events_of,
    make_agent,
    make_hello,
    make_server,
    roundtrip,
)

# ---- welcome


def test_a_camera_is_welcomed_with_the_common_codecs_in_its_order() -> None:
    server = make_server(color_codecs=(1, 2, 3), depth_codecs=(9, 5))
    peer = AgentPeer(make_hello(color_codecs=(7, 3, 1), depth_codecs=(5, 9)))
    server.receive_datagram(peer.hello, AGENT, T0)
    [(datagram, _)] = server.datagrams_to_send(T0)
    welcome = peer.accept(datagram)
    assert (welcome.camera_id, welcome.color_codecs, welcome.depth_codecs) == (0, (3, 1), (5, 9))


def test_a_stream_that_is_not_offered_is_not_chosen() -> None:
    server, peer = make_server(), AgentPeer(make_hello(color_codecs=()))
    server.receive_datagram(peer.hello, AGENT, T0)
    [(datagram, _)] = server.datagrams_to_send(T0)
    welcome = peer.accept(datagram)
    assert (welcome.color_codecs, welcome.depth_codecs) == ((), (DEPTH,))


@pytest.mark.parametrize("ciphers", [tuple(Cipher), tuple(reversed(Cipher)), (Cipher.AES_256_GCM,)])
def test_the_agents_first_cipher_is_taken_and_works_end_to_end(ciphers: tuple[Cipher, ...]) -> None:
    server = make_server()
    agent = joined(server, make_hello(ciphers=ciphers))
    assert agent.session is not None
    assert agent.session.cipher is ciphers[0]
    deliver(server, agent)
    assert [type(event) for event in events_of(server)] == [FrameReceived]


def test_a_session_begins_with_the_agents_first_sealed_message_not_with_its_hello() -> None:
    server = make_server()
    peer = welcomed(server, AgentPeer())
    assert events_of(server) == []
    assert server.cameras == {}
    server.receive_datagram(peer.seal(Heartbeat({"t": 1.0})), AGENT, T0)
    [event] = events_of(server)
    assert isinstance(event, CameraJoined)
    assert (event.camera_id, event.hello.name, event.address) == (0, "cam00", AGENT)
    assert server.cameras[0].health == {"t": 1.0}
    server.handle_timeout(T0)
    assert peer.read(datagram for datagram, _ in server.datagrams_to_send(T0)) == [ClockRequest(T0)]


def test_a_repeated_hello_gets_the_same_welcome_and_no_second_handshake() -> None:
    server = make_server()
    for k in range(3):
        server.receive_datagram(HELLO, AGENT, T0 + k)
    first, *others = server.datagrams_to_send(T0)
    assert others == [first, first]
    assert server.rejected == {}


def test_an_agent_that_opened_its_socket_anew_is_answered_at_its_new_address() -> None:
    server, peer = make_server(), AgentPeer()
    server.receive_datagram(peer.hello, AGENT, T0)
    server.datagrams_to_send(T0)  # lost
    later_ns = T0 + SECOND_NS // 10  # an agent repeats its hello after that at the earliest
    welcomed(server, peer, OTHER, later_ns)
    server.receive_datagram(peer.seal(Heartbeat({})), OTHER, later_ns)
    assert [type(event) for event in events_of(server)] == [CameraJoined]


def test_a_recorded_hello_of_a_session_that_began_changes_nothing() -> None:
    server = make_server()
    peer = joined_peer(server)
    server.receive_datagram(peer.hello, AGENT, T0 + STEP_NS)
    server.receive_datagram(peer.hello, OTHER, T0 + 2 * STEP_NS)
    assert (events_of(server), server.datagrams_to_send(T0)) == ([], [])
    assert server.rejected == {"stale_hello": 2}
    server.receive_datagram(peer.seal(Heartbeat({"still": 1.0})), AGENT, T0)
    assert server.cameras[0].health == {"still": 1.0}


def test_a_recorded_hello_of_before_the_servers_restart_is_answered_and_changes_nothing() -> None:
    """Nobody can know that it is old; only who holds its secrets can go on from there."""
    server = make_server()
    live = joined_peer(server, seed=9)
    recorded = AgentPeer(seed=10).hello
    server.receive_datagram(recorded, AGENT, T0 + STEP_NS)
    [(welcome, _)] = server.datagrams_to_send(T0 + STEP_NS)
    assert len(welcome) <= len(recorded)
    server.receive_datagram(pack_prefix(MessageType.HEARTBEAT, 0, 1) + bytes(40), AGENT, T0 + STEP_NS)
    assert events_of(server) == []
    server.receive_datagram(live.seal(Heartbeat({"still": 1.0})), AGENT, T0 + STEP_NS)
    assert server.cameras[0].health == {"still": 1.0}


def test_a_flood_of_recorded_hellos_costs_a_bounded_table_and_a_hundred_handshakes_a_second() -> None:
    server = make_server()
    live = joined_peer(server)
    hellos = [AgentPeer(seed=100 + k).hello for k in range(1000)]
    answered = []
    for k, hello in enumerate(hellos):
        now_ns = T0 + k * 1_000_000
        server.receive_datagram(hello, OTHER, now_ns)
        answered += [now_ns for _, to in server.datagrams_to_send(now_ns) if to == OTHER]
    assert sum(now_ns >= T0 + SECOND_NS // 2 for now_ns in answered) == 50
    assert len(answered) <= 100 + 64  # what was saved up before
    assert len(server._reception._pending._by_id) == len(server._reception._pending._ids) == MAX_PENDING
    assert server.rejected == {"handshake_limit": 1000 - len(answered)}
    server.receive_datagram(live.seal(Heartbeat({"still": 1.0})), AGENT, now_ns)
    assert server.cameras[0].health == {"still": 1.0}


def test_a_whole_rig_that_says_hello_in_the_same_moment_is_welcomed_at_once() -> None:
    server = make_server()
    for camera_id in range(12):
        peer = AgentPeer(make_hello(camera_id=camera_id, serial=f"S{camera_id}"), seed=100 + camera_id)
        welcomed(server, peer, (AGENT[0], camera_id), T0)


def test_session_ids_come_from_the_source_but_never_zero_or_twice() -> None:
    ids = iter([0, 5, 5, 0, 6])
    server = make_server(random_bytes=lambda n: next(ids).to_bytes(8, "little") if n == 8 else bytes([7]) * n)
    welcomes = []
    for camera_id in (0, 1):
        peer = AgentPeer(make_hello(camera_id=camera_id, serial=f"S{camera_id}"), seed=camera_id)
        server.receive_datagram(peer.hello, (AGENT[0], camera_id), T0 + camera_id * STEP_NS)
        [(datagram, _)] = server.datagrams_to_send(T0)
        welcomes.append(peer.accept(datagram).session_id)
    assert welcomes == [5, 6]


def test_a_restarted_agent_replaces_its_session_at_once() -> None:
    server = make_server()
    old = joined_peer(server)
    new = make_agent(seed=3)
    roundtrip(new, server, OTHER, T0 + STEP_NS)  # same serial, another port
    assert [type(event) for event in events_of(server)] == [CameraLeft, CameraJoined]
    server.datagrams_to_send(T0)
    server.receive_datagram(old.seal(Heartbeat({})), AGENT, T0 + SECOND_NS)
    assert isinstance(the_answer(server), UnknownSession)
    assert server.cameras[0].address == OTHER


# ---- refusals


@pytest.mark.parametrize("version", [1, 7])
def test_a_hello_of_another_version_is_answered_readably_in_all_versions(version: int) -> None:
    server = make_server()
    foreign = bytearray(pack_prefix(MessageType.HELLO, 0, 1234) + bytes(600))  # a body that we cannot read
    foreign[2] = version
    server.receive_datagram(with_crc(foreign), AGENT, T0)
    [(datagram, address)] = server.datagrams_to_send(T0)
    assert address == AGENT
    assert (datagram[:4], datagram[8:16]) == (b"KR\x02\x03", (1234).to_bytes(8, "little"))
    assert tuple(datagram[16:20]) == (RejectReason.VERSION_MISMATCH.value, 2, 2, 0)
    assert int.from_bytes(datagram[4:8], "little") == zlib.crc32(datagram[:4] + datagram[8:])
    text = datagram[20:].decode()
    assert f"the agent speaks protocol version {version}, this server speaks 2" in text
    assert events_of(server) == [HelloRefused(AGENT, RejectReason.VERSION_MISMATCH, text)]
    assert server.rejected == {"refused_version_mismatch": 1}


@pytest.mark.parametrize(
    ("rig_key", "agents_key", "advice"),
    [
        (KEY, RigKey(bytes(32)), "copy the server's key file to the agent's machine"),
        (KEY, RigKey.INSECURE, "start neither with --insecure"),
        (RigKey.INSECURE, KEY, "this server runs with --insecure, the agent does not"),
    ],
)
def test_an_agent_with_another_key_is_refused_and_told_what_to_do(
    rig_key: RigKey, agents_key: RigKey, advice: str
) -> None:
    server, agent = make_server(rig_key=rig_key), make_agent(rig_key=agents_key)
    roundtrip(agent, server)
    [rejected] = events_of(agent)
    assert rejected.reason is RejectReason.WRONG_KEY
    assert advice in rejected.text
    assert events_of(server) == [HelloRefused(AGENT, RejectReason.WRONG_KEY, rejected.text)]
    assert server.rejected == {"refused_wrong_key": 1}
    assert server.cameras == {}


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
    server.receive_datagram(AgentPeer(hello).hello, AGENT, T0)
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
    other = AgentPeer(make_hello(serial="S2"))
    server.receive_datagram(other.hello, OTHER, T0 + 700_000_000)
    reject = the_answer(server)
    assert isinstance(reject, Reject)
    assert reject.reason is RejectReason.DUPLICATE_SLOT
    assert "serial A00362A01234047A" in reject.text
    assert "192.0.2.1:40001" in reject.text
    welcomed(server, other, OTHER, T0 + 750_000_000)


def test_who_never_confirms_does_not_push_out_the_holder_of_a_slot() -> None:
    """Its hello came while the holder was quiet, or is a copy of the holder's own."""
    server = make_server()
    holder = joined_peer(server)
    welcomed(server, AgentPeer(seed=20), OTHER, T0 + STEP_NS)
    welcomed(server, AgentPeer(make_hello(serial="S2"), seed=21), OTHER, T0 + SECOND_NS)
    server.handle_timeout(T0 + SECOND_NS)
    server.receive_datagram(holder.seal(Heartbeat({"still": 1.0})), AGENT, T0 + SECOND_NS)
    assert events_of(server) == []
    assert server.cameras[0].health == {"still": 1.0}


def test_of_two_agents_welcomed_to_one_slot_the_second_to_confirm_has_no_session() -> None:
    server = make_server()
    first = welcomed(server, AgentPeer(make_hello(serial="S1"), seed=20), AGENT, T0)
    second = welcomed(server, AgentPeer(make_hello(serial="S2"), seed=21), OTHER, T0 + STEP_NS)
    for peer, address in ((first, AGENT), (second, OTHER)):
        server.receive_datagram(peer.seal(Heartbeat({})), address, T0 + STEP_NS)
    assert [event.address for event in events_of(server)] == [AGENT]
    assert server.rejected == {"unknown_session": 1}
    assert isinstance(the_answer(server), UnknownSession)  # upon which it says hello and is told why


def test_a_first_heartbeat_that_somebody_held_back_ends_no_session() -> None:
    """The agent of a welcome gave up and joined anew; then its first heartbeat of before is delivered."""
    server = make_server()
    first = welcomed(server, AgentPeer(seed=20), AGENT, T0)
    held_back = first.seal(Heartbeat({}))
    second = welcomed(server, AgentPeer(seed=21), AGENT, T0 + 2 * SECOND_NS)
    server.receive_datagram(second.seal(Heartbeat({})), AGENT, T0 + 2 * SECOND_NS)
    assert [type(event) for event in events_of(server)] == [CameraJoined]
    server.receive_datagram(held_back, AGENT, T0 + 3 * SECOND_NS)
    assert events_of(server) == []


def test_an_offer_that_nobody_took_for_three_seconds_is_over() -> None:
    server = make_server()
    peer = welcomed(server, AgentPeer(), AGENT, T0)
    server.receive_datagram(peer.seal(Heartbeat({})), AGENT, T0 + 4 * SECOND_NS)
    assert events_of(server) == []
    assert server.rejected == {"stale_hello": 1}


def test_a_malformed_hello_of_a_holder_of_the_key_is_answered_with_what_is_wrong() -> None:
    server = make_server()
    values = {**msgpack.unpackb(encode_body(make_hello())[1]), "fps": "fast"}
    server.receive_datagram(sealed_hello(msgpack.packb(values)), AGENT, T0)
    reject = the_answer(server)
    assert isinstance(reject, Reject)
    assert (reject.reason, "fps" in reject.text) == (RejectReason.MALFORMED, True)


def test_a_public_key_of_low_order_begins_no_session() -> None:
    server = make_server()
    server.receive_datagram(sealed_hello(encode_body(make_hello())[1], public=bytes(32)), AGENT, T0)
    assert server.datagrams_to_send(T0) == []
    assert server.rejected == {"malformed": 1}


def test_refusals_are_reported_once_a_second_and_answered_ten_times_a_second_and_address() -> None:
    server = make_server(Roster())
    for k in range(200):
        server.receive_datagram(HELLO, AGENT, T0 + k * SECOND_NS // 100)
    assert len(server.datagrams_to_send(T0)) == 20
    assert len(events_of(server)) == 2
    assert server.rejected == {"refused_unknown_camera": 40, "handshake_limit": 160}


def test_a_stranger_with_ten_thousand_ports_is_told_of_a_few_times_a_second() -> None:
    """Hellos of another version with a right checksum: the owner writes a log line for each event."""
    foreign = bytearray(pack_prefix(MessageType.HELLO, 0, 1234) + bytes(600))
    foreign[2] = 9
    hello, server = with_crc(foreign), make_server()
    for port in range(10_000):
        server.receive_datagram(hello, ("192.0.2.9", port), T0 + port * 100_000)
        server.receive_datagram(hello, (f"198.51.100.{port % 250}", port), T0 + port * 100_000)
    assert len(events_of(server)) <= 16 + 5 + 1
    assert server.rejected == {"refused_version_mismatch": 20_000}


def test_no_answer_to_a_stranger_is_longer_than_what_it_sent() -> None:
    server = make_server(Roster((Slot(0, "n" * 300, serial="s" * 300),)))
    text = "n" * 64
    longest = AgentPeer(make_hello(name=text, serial=text, port_path=text)).hello
    foreign = AgentPeer(rig_key=RigKey(bytes(32))).hello
    unknown = pack_prefix(MessageType.GOODBYE, 0, 9) + bytes(24)
    for k, datagram in enumerate((longest, foreign, unknown, clear(UnknownSession(), 9), HELLO)):
        server.receive_datagram(datagram, (AGENT[0], k), T0 + k * SECOND_NS)
        for answer, _ in server.datagrams_to_send(T0):
            assert len(answer) <= min(len(datagram), MIN_HELLO_SIZE)
    assert server.rejected.total() == 5
