"""Nobody without the key is believed a single bit; every message is taken once, in whatever order."""

from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig_protocol.clear_datagram import clear_crc
from rig_protocol.datagram import MessageType
from rig_protocol.events import CameraJoined, FrameReceived, HelloRefused, Rejected
from rig_protocol.messages import ClockReply, ClockRequest, Heartbeat, StreamPlan
from rig_protocol.sealed_channel import ReplayWindow
from rig_protocol.security import Cipher
from rig_protocol.server_link import ServerLink
from support.peers import AgentPeer, ServerPeer
from support.wire import AGENT, COLOR, T0, events_of, make_agent, make_frame, make_hello, make_server

examples = settings(deadline=None, derandomize=True, max_examples=300)
CIPHERS = st.sampled_from(Cipher)
REFUSALS = {MessageType.REJECT, MessageType.UNKNOWN_SESSION}
ANY = st.integers(0, 10**6)  # taken modulo the number of bits


def flipped(datagram: bytes, bit: int) -> bytes:
    """One bit altered."""
    harmed = bytearray(datagram)
    harmed[bit % (8 * len(harmed)) // 8] ^= 1 << bit % 8
    return bytes(harmed)


def alterations(datagram: bytes) -> Iterator[bytes]:
    """Every bit altered, and again with the checksum that then fits, so that only the seal can tell."""
    for bit in range(8 * len(datagram)):
        harmed = flipped(datagram, bit)
        yield harmed
        if not 32 <= bit < 64:  # the checksum itself, which would be right again
            yield harmed[:4] + clear_crc(harmed).to_bytes(4, "little") + harmed[8:]


def test_a_hello_of_which_any_bit_is_altered_begins_nothing() -> None:
    server = make_server()
    for count, harmed in enumerate(alterations(AgentPeer().hello), start=1):
        server.receive_datagram(harmed, AGENT, T0 + count * 100_000_000)
        assert server.rejected.total() == count
        assert {type(event) for event in events_of(server)} <= {HelloRefused}
        assert {answer[3] for answer, _ in server.datagrams_to_send(T0)} <= REFUSALS
    assert len(server._reception._pending._by_id) == 0


def test_a_welcome_of_which_any_bit_is_altered_is_not_followed() -> None:
    agent, server = make_agent(), ServerPeer()
    welcome = server.welcome(agent.datagrams_to_send(T0)[0])
    for count, harmed in enumerate(alterations(welcome), start=1):
        agent.receive_datagram(harmed, T0)
        # Anybody may say REJECT: it only puts off the next hello.
        assert {type(event) for event in events_of(agent)} <= {Rejected}
        assert sum(agent.counters.rejected.values()) + agent.counters.rejects == count
    assert agent.counters.rejects == 1
    assert agent._session is None
    agent.receive_datagram(welcome, T0)
    assert agent._session is not None


@pytest.mark.parametrize("cipher", Cipher)
def test_a_message_to_the_server_of_which_any_bit_is_altered_is_not_read(cipher: Cipher) -> None:
    server, agent = joined(cipher)
    datagram = agent.seal(Heartbeat({"t": 1.0}, 5))
    for count, harmed in enumerate(alterations(datagram), start=1):
        server.receive_datagram(harmed, AGENT, T0)
        assert server.rejected.total() == count
    assert server.cameras[0].health == {}
    assert server.cameras[0].connected
    server.receive_datagram(datagram, AGENT, T0)
    assert server.cameras[0].health == {"t": 1.0}


@pytest.mark.parametrize("cipher", Cipher)
def test_a_message_to_the_agent_of_which_any_bit_is_altered_is_not_read(cipher: Cipher) -> None:
    agent, server = make_agent(), ServerPeer()
    agent.receive_datagram(server.welcome(agent.datagrams_to_send(T0)[0], cipher=cipher), T0)
    agent.receive_datagram(server.seal(ClockRequest(1)), T0)
    datagram = server.seal(StreamPlan(COLOR, None, 15.0, 1000, 5, 0.8, 0))
    for count, harmed in enumerate(alterations(datagram), start=1):
        agent.receive_datagram(harmed, T0)
        assert sum(agent.counters.rejected.values()) == count
    assert (agent.plan, agent.connected) == (None, True)
    agent.receive_datagram(datagram, T0)
    assert agent.plan is not None


@examples
@given(ANY, CIPHERS, st.integers(0, 3))
def test_an_altered_fragment_delivers_nothing_but_what_was_sent(bit: int, cipher: Cipher, which: int) -> None:
    server, agent = joined(cipher)
    clocked(server, agent)
    sent = [bytes(datagram) for datagram in agent.fragments(make_frame(timestamp_ns=T0, size=5000), 0)]
    harmed = [flipped(datagram, bit) if k == which else datagram for k, datagram in enumerate(sent)]
    for datagram in harmed:
        server.receive_datagram(datagram, AGENT, T0)
    assert [event for event in events_of(server) if isinstance(event, FrameReceived)] == []


def joined(cipher: Cipher) -> tuple[ServerLink, AgentPeer]:
    """A session under a cipher."""
    server, agent = make_server(), AgentPeer(make_hello(ciphers=(cipher,)))
    server.receive_datagram(agent.hello, AGENT, T0)
    agent.accept(server.datagrams_to_send(T0)[0][0])
    server.receive_datagram(agent.seal(Heartbeat({})), AGENT, T0)
    assert [type(event) for event in events_of(server)] == [CameraJoined]
    return server, agent


def clocked(server: ServerLink, agent: AgentPeer) -> None:
    """Let the server know the agent's clock, so that frames can be delivered."""
    server.handle_timeout(T0)
    for request in agent.read(datagram for datagram, _ in server.datagrams_to_send(T0)):
        assert isinstance(request, ClockRequest)
        server.receive_datagram(agent.seal(ClockReply(request.t1_ns, T0, T0)), AGENT, T0)
    assert server.cameras[0].clock is not None


@examples
@given(st.permutations(range(6)), st.lists(st.integers(0, 5), max_size=8), CIPHERS)
def test_every_message_is_taken_once_in_whatever_order_and_however_often_it_comes(
    order: list[int], repeated: list[int], cipher: Cipher
) -> None:
    server, agent = joined(cipher)
    datagrams = [agent.seal(Heartbeat({"k": float(k)})) for k in range(6)]
    for k in (*order, *repeated):
        server.receive_datagram(datagrams[k], AGENT, T0)
    assert server.rejected["replayed"] == len(repeated)
    assert server.cameras[0].health == {"k": float(order[-1])}


@examples
@given(st.lists(st.integers(0, 300) | st.integers(0, 2**64 - 1), max_size=120))
def test_the_replay_window_accepts_what_a_perfect_memory_of_64_counters_would(counters: list[int]) -> None:
    window, seen = ReplayWindow(), set[int]()
    for counter in counters:
        expected = counter not in seen and counter > max(seen, default=-1) - 64
        assert window.is_fresh(counter) == expected
        if expected:
            window.accept(counter)
            seen.add(counter)
