"""Rules of remote control: what is asked is done once, in order, and told once, whatever the network does."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig_protocol.agent_link import AgentLink
from rig_protocol.datagram import MessageType
from rig_protocol.errors import DataError, LinkUsageError
from rig_protocol.events import ControlAnswered, ControlRequested, Outcome
from rig_protocol.message_bytes import decode_body, encode_body
from rig_protocol.messages import Control, ControlResult, ControlValue, Heartbeat
from rig_protocol.remote_control import (
    CONTROL_PATIENCE_NS,
    MAX_WAITING_CONTROLS,
    ControlReceiver,
    ControlSender,
)
from rig_protocol.server_link import ServerLink
from rig_protocol.testing import Faults, LossyLink, VirtualAgent, VirtualNetwork
from support.peers import AgentPeer, ServerPeer
from support.wire import AGENT, SECOND_NS, T0, events_of, make_agent, make_hello, make_server, roundtrip

ROUGH = Faults(
    drop=0.3, duplicate=0.2, reorder=0.2, reorder_ns=150_000_000, jitter_ns=20_000_000, corrupt=0.05
)
CONTROLLED = make_hello(controls=True)


def connected() -> tuple[ServerLink, AgentLink]:
    server, agent = make_server(), make_agent(CONTROLLED)
    roundtrip(agent, server)
    events_of(server), events_of(agent)
    return server, agent


def answers(events: list[Any]) -> list[ControlAnswered]:
    return [event for event in events if isinstance(event, ControlAnswered)]


def test_a_control_is_asked_done_and_told() -> None:
    server, agent = connected()
    ticket = server.control(0, "tilt_deg", 5, T0)
    roundtrip(agent, server)
    [request] = events_of(agent)
    assert (request.name, request.value) == ("tilt_deg", 5.0)
    agent.answer_control(request, done=True, text="tilted to 5°")
    roundtrip(agent, server)
    assert events_of(server) == [ControlAnswered(0, ticket, Outcome.DONE, "tilted to 5°")]


def test_a_refusal_is_told_in_the_agents_words() -> None:
    server, agent = connected()
    ticket = server.control(0, "sing", "louder", T0)
    roundtrip(agent, server)
    [request] = events_of(agent)
    agent.answer_control(request, done=False, text="there is no control sing")
    roundtrip(agent, server)
    assert events_of(server) == [ControlAnswered(0, ticket, Outcome.REFUSED, "there is no control sing")]


@pytest.mark.parametrize("seed", range(4))
def test_on_a_rough_network_everything_is_done_once_in_order_and_told_once(seed: int) -> None:
    network = VirtualNetwork(make_server())
    done: list[ControlRequested] = []

    def obey(request: ControlRequested) -> str:
        done.append(request)
        return f"did {request.value}"

    agent = VirtualAgent(
        make_agent(CONTROLLED, seed),
        AGENT,
        LossyLink(seed, ROUGH),
        LossyLink(seed + 100, ROUGH),
        obey=obey,
    )
    network.agents.append(agent)
    network.run(3.0)
    assert network.server is not None
    tickets = [network.server.control(0, "tilt_deg", k, network.now_ns) for k in range(12)]
    network.run(20.0)
    told = answers(network.server_events)
    assert [request.value for request in done] == list(range(12))
    assert [(one.ticket, one.outcome, one.text) for one in told] == [
        (ticket, Outcome.DONE, f"did {k}.0") for k, ticket in enumerate(tickets)
    ]


def test_a_repeated_control_is_not_done_again_but_answered_again() -> None:
    server, agent = ServerPeer(), make_agent(CONTROLLED)
    agent.receive_datagram(server.welcome(agent.datagrams_to_send(T0)[0], controls=True), T0)
    for _ in range(3):
        agent.receive_datagram(server.seal(Control(1, "depth", False)), T0)
    [_, request] = events_of(agent)
    assert ControlResult not in map(type, server.read(agent.datagrams_to_send(T0)))
    agent.answer_control(request, done=True, text="off")
    for _ in range(2):
        assert ControlResult(1, True, "off") in server.read(agent.datagrams_to_send(T0))
        agent.receive_datagram(server.seal(Control(1, "depth", False)), T0)
    assert events_of(agent) == []


def test_an_agent_that_offers_no_controls_is_told_none() -> None:
    server, agent = make_server(), make_agent(make_hello())
    roundtrip(agent, server)
    events_of(server), events_of(agent)
    server.control(0, "led", "green", T0)
    [answer] = events_of(server)
    assert answer.outcome is Outcome.REFUSED
    assert "upgrade" in answer.text
    roundtrip(agent, server)
    assert events_of(agent) == []


def test_a_control_that_was_not_agreed_on_is_dropped() -> None:
    server, agent = ServerPeer(), make_agent(CONTROLLED)
    agent.receive_datagram(server.welcome(agent.datagrams_to_send(T0)[0]), T0)
    agent.receive_datagram(server.seal(Control(1, "depth", False)), T0)
    assert ControlRequested not in map(type, events_of(agent))
    assert agent.counters.rejected["unexpected_type"] == 1


def test_a_camera_that_is_not_connected_cannot_be_controlled() -> None:
    server = make_server()
    ticket = server.control(5, "led", "green", T0)
    assert events_of(server) == [ControlAnswered(5, ticket, Outcome.REFUSED, "it is not connected")]


def test_a_session_that_ends_leaves_no_control_untold() -> None:
    server, agent = connected()
    tickets = [server.control(0, "restart", True, T0) for _ in range(3)]
    agent.close(T0)
    roundtrip(agent, server)
    told = answers(events_of(server))
    assert [one.ticket for one in told] == tickets
    assert {one.outcome for one in told} == {Outcome.UNANSWERED}


def test_an_agent_that_does_not_answer_in_time_is_given_up_and_the_next_is_asked() -> None:
    server = make_server()
    peer = AgentPeer(CONTROLLED)
    server.receive_datagram(peer.hello, AGENT, T0)
    peer.accept(server.datagrams_to_send(T0)[0][0])
    tickets = []
    for k in range(0, CONTROL_PATIENCE_NS + SECOND_NS, SECOND_NS // 2):
        server.receive_datagram(peer.seal(Heartbeat({})), AGENT, T0 + k)
        if k == 0:
            tickets = [server.control(0, "depth", on, T0) for on in (False, True)]
        server.handle_timeout(T0 + k)
    [told] = answers(events_of(server))
    assert (told.ticket, told.outcome) == (tickets[0], Outcome.UNANSWERED)
    asked = [one for one in peer.read(d for d, _ in server.datagrams_to_send(T0)) if isinstance(one, Control)]
    assert asked[-1] == Control(2, "depth", True)
    # What comes after all belongs to nothing that is asked now.
    server.receive_datagram(peer.seal(ControlResult(1, True, "off")), AGENT, T0 + CONTROL_PATIENCE_NS)
    assert answers(events_of(server)) == []
    assert server.rejected["stale_result"] == 1


def test_more_than_an_operator_asks_is_refused_at_once() -> None:
    server, _ = connected()
    for _ in range(MAX_WAITING_CONTROLS + 1):
        server.control(0, "led", "green", T0)
    [told] = answers(events_of(server))
    assert (told.ticket, told.outcome) == (MAX_WAITING_CONTROLS + 1, Outcome.REFUSED)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("", 1),
        ("x" * 33, 1),
        ("led\n", 1),
        ("led", ""),
        ("led", "x" * 65),
        ("led", float("nan")),
        ("led", None),
    ],
)
def test_a_control_out_of_range_is_malformed_and_cannot_be_sent(name: str, value: Any) -> None:
    with pytest.raises(LinkUsageError, match="this control cannot be sent"):
        make_server().control(0, name, value, T0)


VALUES = (
    st.booleans() | st.floats(allow_nan=False, allow_infinity=False) | st.sampled_from(["green", "é" * 32])
)
examples = settings(deadline=None, derandomize=True, max_examples=100)


@examples
@given(st.integers(1, 2**32 - 1), VALUES)
def test_a_control_is_read_as_it_was_written(number: int, value: ControlValue) -> None:
    control = Control(number, "name", value)
    read = decode_body(*encode_body(control))
    assert isinstance(read, Control)
    assert read == control
    assert isinstance(read.value, bool) == isinstance(value, bool)


@examples
@given(st.text(max_size=300))
def test_any_words_of_an_agent_can_be_sent_and_read(words: str) -> None:
    read = decode_body(*encode_body(ControlResult(1, False, words)))
    assert isinstance(read, ControlResult)
    assert len(read.text.encode()) <= 200


@pytest.mark.parametrize("body", [b"", b"\x80", b"\x83\xa6number\x01\xa4done\x01\xa4text\xa0"])
def test_a_result_without_a_plain_yes_or_no_is_malformed(body: bytes) -> None:
    with pytest.raises(DataError):
        decode_body(MessageType.CONTROL_RESULT, body)


@examples
@given(st.lists(st.integers(1, 6) | st.just(2**32 - 1), max_size=40))
def test_no_order_of_numbers_makes_a_control_done_twice(numbers: list[int]) -> None:
    receiver = ControlReceiver()
    done = [number for number in numbers if receiver.take(Control(number, "depth", True))]
    assert done == sorted(set(done))


@examples
@given(st.lists(st.integers(0, 9), max_size=40))
def test_whatever_results_come_every_ticket_is_told_once(numbers: list[int]) -> None:
    sender = ControlSender()
    tickets = [ticket for ticket in range(5) if sender.ask(ticket, "led", "green", T0)]
    told = []
    for k, number in enumerate(numbers):
        sender.messages_due(T0 + k)
        ticket = sender.take_result(ControlResult(number, True, ""), T0 + k)
        told += [] if ticket is None else [ticket]
    assert told + sender.close() == tickets
