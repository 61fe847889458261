"""Rules of agents without a slot: who is listed, for how long, and that strangers cannot fill the list."""

from dataclasses import replace

from rig_protocol.events import HelloRefused
from rig_protocol.messages import RejectReason
from rig_protocol.roster import Roster, Slot
from rig_server.unassigned import MAX_UNASSIGNED, UnassignedAgents
from support.wire import AGENT, SECOND_NS, T0, events_of, make_agent, make_hello, make_server, roundtrip

REFUSED = HelloRefused(
    AGENT,
    RejectReason.UNKNOWN_CAMERA,
    "it is not in the rig",
    make_hello(name="pi-7", camera_id=None, serial="B7"),
)


def test_an_agent_that_the_roster_does_not_know_is_told_with_what_it_says() -> None:
    server = make_server(Roster((Slot(0, "cam00", serial="A0"),)))
    roundtrip(make_agent(make_hello(camera_id=None, serial="B7", port_path=None)), server)
    [event] = events_of(server)
    assert event.reason is RejectReason.UNKNOWN_CAMERA
    assert event.hello.serial == "B7"


def test_a_new_roster_holds_for_the_hellos_that_come_then() -> None:
    server = make_server(Roster((Slot(0, "cam00", serial="A0"),)))
    agent = make_agent(make_hello(camera_id=None, serial="B7", port_path=None))
    roundtrip(agent, server)
    server.roster = server.roster.with_slot(Slot(4, "stage", serial="B7"))
    roundtrip(agent, server, now_ns=T0 + 6 * SECOND_NS)
    assert agent.session is not None
    assert agent.session.camera_id == 4


def test_a_camera_that_gets_another_slot_leaves_its_old_one() -> None:
    roster = Roster((Slot(0, "cam00", serial="A0"), Slot(1, "cam01"))).with_slot(
        Slot(1, "cam01", serial="A0")
    )
    assert roster.slots == (Slot(0, "cam00"), Slot(1, "cam01", serial="A0"))


def test_it_is_listed_as_long_as_it_says_hello() -> None:
    agents = UnassignedAgents()
    agents.take(REFUSED, T0)
    [agent] = agents.here(T0 + 20 * SECOND_NS)
    assert str(agent) == "pi-7 (serial B7, port 1-1.2, at 192.0.2.1)"
    agents.take(REFUSED, T0 + 25 * SECOND_NS)
    assert len(agents.here(T0 + 50 * SECOND_NS)) == 1
    assert agents.here(T0 + 60 * SECOND_NS) == ()


def test_who_was_refused_for_another_reason_or_without_the_key_is_not_listed() -> None:
    agents = UnassignedAgents()
    agents.take(replace(REFUSED, reason=RejectReason.DUPLICATE_SLOT), T0)
    agents.take(replace(REFUSED, hello=None), T0)
    assert agents.here(T0) == ()


def test_an_agent_that_was_given_a_slot_is_listed_no_more() -> None:
    agents = UnassignedAgents()
    agents.take(REFUSED, T0)
    agents.forget({"B7"})
    assert agents.here(T0) == ()


def test_the_list_is_bounded_and_the_latest_stay() -> None:
    agents = UnassignedAgents()
    for k in range(3 * MAX_UNASSIGNED):
        agents.take(replace(REFUSED, address=(f"192.0.2.{k}", 4000)), T0 + k)
    here = agents.here(T0 + 1000)
    assert len(here) == MAX_UNASSIGNED
    assert f"192.0.2.{3 * MAX_UNASSIGNED - 1}" in {agent.host for agent in here}
