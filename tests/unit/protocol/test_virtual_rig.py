"""Both ends wired in memory through lossy links, in virtual time: twelve agents and every fault."""

import random
from collections import Counter

import pytest

from rig_protocol.clear_datagram import encode_clear
from rig_protocol.counters import CameraCounters
from rig_protocol.events import (
    Address,
    CameraJoined,
    CameraLeft,
    Connected,
    Disconnected,
    FrameReceived,
    HelloRefused,
    Rejected,
)
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.message_bytes import encode_body
from rig_protocol.messages import RejectReason, StreamChoice, UnknownSession
from rig_protocol.open_unit import REORDER_NS
from rig_protocol.rig_key import RigKey
from rig_protocol.roster import Roster, Slot
from rig_protocol.testing import AgentClock, Faults, LossyLink, VirtualAgent, VirtualNetwork
from support.wire import COLOR, DEPTH, SECOND_NS, make_agent, make_frame, make_hello, make_server

FPS = 30
CLEAN = Faults()
ROUGH = Faults(drop=0.01, burst=0.0005, duplicate=0.02, reorder=0.05, jitter_ns=500_000, corrupt=0.002)


def add_agent(
    network: VirtualNetwork, camera_id: int, faults: Faults = CLEAN, seed: int = 0, **changes: object
) -> VirtualAgent:
    """An agent at its own address with a clock of its own; its frames are 3 fragments long."""
    seed = 1000 * seed + 10 * camera_id
    agent = VirtualAgent(
        link=make_agent(make_hello(camera_id=camera_id, serial=f"S{camera_id}", **changes), seed),
        address=(f"192.0.2.{camera_id}", 40000 + seed),
        uplink=LossyLink(seed + 1, faults),
        downlink=LossyLink(seed + 2, faults),
        clock=AgentClock(offset_ns=camera_id * 10**12, drift_ppm=random.Random(seed).uniform(-50, 50)),
        make_frame=lambda sequence, agent_ns: make_frame(sequence, agent_ns),
        next_frame_ns=network.now_ns + camera_id * 2_500_000,
    )
    network.agents.append(agent)
    return agent


def make_rig(faults: Faults, cameras: int = 12) -> VirtualNetwork:
    network = VirtualNetwork(make_server())
    for camera_id in range(cameras):
        add_agent(network, camera_id, faults)
    return network


def frames_of(network: VirtualNetwork) -> dict[int, list[EncodedFrame]]:
    frames: dict[int, list[EncodedFrame]] = {}
    for event in network.server_events:
        if isinstance(event, FrameReceived):
            frames.setdefault(event.frame.camera_id, []).append(event.frame)
    return frames


def assert_delivered_frames_are_true(network: VirtualNetwork) -> None:
    """Content bit for bit, and no frame twice."""
    for frames in frames_of(network).values():
        seen = [frame.sequence for frame in frames]
        assert len(seen) == len(set(seen))
        for frame in frames:
            sent = make_frame(frame.sequence)
            assert (frame.color, frame.depth) == (sent.color, sent.depth)


def test_twelve_agents_on_a_clean_network_lose_nothing() -> None:
    network = make_rig(CLEAN)
    network.run(3.0)
    assert network.server is not None
    assert not network.server.rejected
    for camera_id, frames in frames_of(network).items():
        counters = network.server.cameras[camera_id].counters
        # Frames before the welcome are not sent; one that overtakes the first clock reply is untimed.
        assert counters.lost == counters.untimed <= 1
        sequences = [frame.sequence for frame in frames]
        assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))
        assert len(frames) >= 3 * FPS - 3
    assert len(frames_of(network)) == 12
    assert_delivered_frames_are_true(network)


def finished(network: VirtualNetwork) -> Counter[str]:
    """Let the last frames arrive or expire, end the sessions; the counters of all cameras together."""
    for agent in network.agents:
        agent.make_frame = None
    network.run(1.0)
    assert network.server is not None
    network.server.close(network.now_ns)
    assert_delivered_frames_are_true(network)
    total: Counter[str] = Counter()
    for camera_id, agent in enumerate(network.agents):
        counters = network.server.cameras[camera_id].counters
        assert len(frames_of(network)[camera_id]) == counters.frames
        total.update({name: getattr(counters, name) for name in CameraCounters.__slots__})
        total.update(lost=counters.lost, sent=agent.link.counters.frames, answered=agent.link.counters.resent)
        total.update(harmed=agent.uplink.done["corrupted"])
    return total


@pytest.mark.parametrize(
    "faults",
    [
        Faults(drop=0.01),
        Faults(drop=0.01, reorder=0.05, duplicate=0.01, jitter_ns=300_000),
        Faults(burst=0.002, burst_length=6),  # two whole frames in a row
        Faults(reorder=0.05),
        Faults(duplicate=0.01),
    ],
    ids=str,
)
def test_a_network_that_loses_one_datagram_of_a_hundred_loses_no_frame(faults: Faults) -> None:
    """Requests, answers, hellos and clocks are lost at the same rate."""
    network = make_rig(faults)
    network.run(3.0)
    total = finished(network)
    assert total["sent"] > 12 * (3 * FPS - 2)
    assert (total["frames"], total["lost"]) == (total["sent"], 0)


def test_a_network_that_loses_five_of_a_hundred_loses_less_than_one_frame_of_a_thousand() -> None:
    network = make_rig(Faults(drop=0.05, reorder=0.02, jitter_ns=300_000))
    network.run(8.0)
    total = finished(network)
    assert total["resent"] > 0.1 * total["sent"]
    assert total["frames"] + total["lost"] == total["sent"] > 2800
    assert total["lost"] - total["untimed"] < 0.001 * total["sent"]


def test_where_nothing_is_lost_nothing_is_asked_for() -> None:
    network = make_rig(Faults(reorder=0.05, reorder_ns=REORDER_NS - 200_000, duplicate=0.01))
    network.run(4.0)
    total = finished(network)
    assert (total["requested"], total["resent"], total["answered"]) == (0, 0, 0)
    assert total["frames"] == total["sent"]


def test_what_was_lost_is_asked_for_about_once() -> None:
    """The round trip takes 0.2 ms: an answer is there before anybody asks again."""
    network = make_rig(Faults(drop=0.02))
    network.run(4.0)
    total = finished(network)
    assert total["requested"] <= 1.1 * total["resent"]
    assert total["duplicate"] == 0


def test_what_no_budget_can_repair_is_counted_by_its_cause() -> None:
    """At 35 % loss a quarter of the bytes again does not do."""
    network = make_rig(Faults(drop=0.35), cameras=2)
    network.run(4.0)
    for agent in network.agents:  # let every agent tell how many frames it sent
        agent.uplink.faults = agent.downlink.faults = CLEAN
    total = finished(network)
    assert total["incomplete"] + total["missing"] > 0
    assert total["frames"] + total["lost"] == total["sent"]
    assert (
        total["answered"] <= 0.25 * 3 * total["sent"] + 2 * 3 * 4
    )  # fragments: 3 a frame, 3 frames saved up


def test_twelve_agents_on_a_rough_network_deliver_only_true_frames_and_count_the_others() -> None:
    network = make_rig(ROUGH)
    network.run(4.0)
    total = finished(network)
    assert total["frames"] >= 0.99 * total["sent"]
    # A bit error in a header can open a unit that was never sent: the sum may exceed what was sent.
    assert total["sent"] <= total["frames"] + total["lost"] <= total["sent"] + total["harmed"]
    assert total["lost"] <= total["harmed"] + total["untimed"]  # what was only lost came again
    assert total["duplicate"] > 0
    assert total["corrupt"] > 0


def test_stamps_are_in_rig_time_within_their_uncertainty() -> None:
    network = make_rig(Faults(jitter_ns=1_000_000), cameras=4)
    network.run(6.0)
    errors = [error for camera_id in range(4) for error in clock_errors(network, camera_id)]
    later = [error for camera_id in range(4) for error in clock_errors(network, camera_id)[FPS // 5 :]]
    assert len(errors) > 600
    assert all(abs(error_ns) <= 4 * uncertainty_ns for error_ns, uncertainty_ns in errors)
    assert max(abs(error_ns) for error_ns, _ in later) < 500_000  # after the first eight exchanges
    within = [abs(error_ns) <= 2 * uncertainty_ns for error_ns, uncertainty_ns in errors]
    assert sum(within) > 0.95 * len(within)


def clock_errors(network: VirtualNetwork, camera_id: int) -> list[tuple[int, int]]:
    """Error and stated uncertainty of every delivered stamp; an agent stamps frames at a steady cadence."""
    agent = network.agents[camera_id]
    errors = []
    for frame in frames_of(network)[camera_id]:
        true_ns = agent.next_frame_ns - (agent.sequence - frame.sequence) * agent.frame_interval_ns
        errors.append((frame.timestamp_ns - true_ns, frame.uncertainty_ns))
    return errors


def test_an_agent_that_is_killed_and_restarted_streams_again_at_once() -> None:
    network = make_rig(CLEAN, cameras=3)
    network.run(2.0)
    network.agents.pop(1)  # killed: no goodbye
    network.run(0.3)
    network.server_events.clear()
    add_agent(network, 1, seed=7)
    network.run(0.5)
    kinds = [type(event) for event in network.server_events if not isinstance(event, FrameReceived)]
    assert kinds == [CameraLeft, CameraJoined]
    assert len(frames_of(network)[1]) >= 13
    assert network.server is not None
    assert network.server.cameras[1].counters.sessions == 2


def test_an_agent_that_stops_for_good_is_reported_after_two_seconds_and_the_others_go_on() -> None:
    network = make_rig(CLEAN, cameras=3)
    network.run(1.0)
    network.agents.pop(0)
    network.server_events.clear()
    network.run(2.5)
    [left] = [event for event in network.server_events if isinstance(event, CameraLeft)]
    assert (left.camera_id, "silent for 2.0 s" in left.text) == (0, True)
    assert {camera_id: len(frames) >= 74 for camera_id, frames in frames_of(network).items()} == {
        1: True,
        2: True,
    }


def test_an_agent_that_says_goodbye_leaves_at_once() -> None:
    network = make_rig(CLEAN, cameras=1)
    network.run(1.0)
    network.agents[0].link.close(0)
    network.agents[0].make_frame = None
    network.run(0.01)
    assert network.server_events[-1] == CameraLeft(0, "goodbye: the agent stops")


@pytest.mark.parametrize("down_s", [0.0, 0.5, 5.0])
def test_agents_stream_again_within_a_second_of_a_server_restart(down_s: float) -> None:
    network = make_rig(CLEAN)
    network.run(1.0)
    network.server = None
    network.run(down_s)
    network.server = make_server(seed=99)
    network.server_events.clear()
    network.run(1.2)
    assert set(frames_of(network)) == set(range(12))
    for agent in network.agents:
        assert any(isinstance(event, Disconnected) for event in agent.events)
        assert isinstance(agent.events[-1], Connected)


def test_a_server_that_stops_says_goodbye_and_agents_say_hello_until_it_is_back() -> None:
    network = make_rig(CLEAN, cameras=2)
    network.run(1.0)
    assert network.server is not None
    network.server.close(network.now_ns)
    network.run(0.01)
    network.server = None
    network.run(10.0)
    assert [type(event) for event in network.agents[0].events] == [Connected, Disconnected]
    assert "goodbye: the server stops" in network.agents[0].events[-1].text
    network.server = make_server(seed=99)
    network.run(1.1)
    assert isinstance(network.agents[0].events[-1], Connected)


def test_an_unknown_camera_is_named_on_both_sides_and_the_rig_goes_on() -> None:
    roster = Roster((Slot(0, "front", serial="S0"),))
    network = VirtualNetwork(make_server(roster))
    add_agent(network, 0)
    stranger = add_agent(network, 1)
    network.run(3.0)
    [first, *_] = [event for event in stranger.events if isinstance(event, Rejected)]
    assert first.reason is RejectReason.UNKNOWN_CAMERA
    assert "serial S1" in first.text
    refused = [event for event in network.server_events if isinstance(event, HelloRefused)]
    assert refused[0] == HelloRefused(stranger.address, RejectReason.UNKNOWN_CAMERA, first.text)
    assert len(stranger.events) == 3  # at 0, 0.5 and 1.5 s: with back-off
    assert set(frames_of(network)) == {0}


def test_a_second_agent_on_a_slot_is_refused_while_the_first_lives_and_takes_over_after() -> None:
    network = VirtualNetwork(make_server())
    first = add_agent(network, 3)
    network.run(1.0)
    second = add_agent(network, 3, seed=5)
    second.link = make_agent(make_hello(camera_id=3, serial="ANOTHER"), seed=6)
    network.run(2.0)
    assert {event.reason for event in second.events if isinstance(event, Rejected)} == {
        RejectReason.DUPLICATE_SLOT
    }
    assert first.link.connected
    network.agents.remove(first)
    network.run(5.5)
    assert second.link.connected


def test_an_agent_without_a_serial_takes_its_slot_back_within_a_second_of_a_restart() -> None:
    network = VirtualNetwork(make_server())
    first = add_agent(network, 0)
    first.link = make_agent(make_hello(serial=None), seed=1)
    network.run(1.0)
    network.agents.remove(first)
    second = add_agent(network, 0, seed=5)
    second.link = make_agent(make_hello(serial=None), seed=2)
    network.run(1.6)
    assert second.link.connected


def test_an_agent_without_a_common_codec_is_told_so() -> None:
    network = VirtualNetwork(make_server())
    agent = add_agent(network, 0, color_codecs=(COLOR + 1,))
    network.run(0.2)
    assert [event.reason for event in agent.events if isinstance(event, Rejected)] == [
        RejectReason.NO_COMMON_CODEC
    ]
    assert f"colour codecs {COLOR + 1}" in agent.events[0].text


def test_an_agent_with_another_key_never_gets_in_and_is_told_why() -> None:
    network = make_rig(CLEAN, cameras=2)
    stranger = add_agent(network, 5)
    stranger.link = make_agent(make_hello(camera_id=5), seed=77, rig_key=RigKey(bytes(32)))
    network.run(4.0)
    assert {type(event) for event in stranger.events} == {Rejected}
    assert stranger.events[0].reason is RejectReason.WRONG_KEY  # type: ignore[union-attr]
    assert stranger.link.counters.frames == 0
    assert set(frames_of(network)) == {0, 1}


def test_agents_give_no_frame_to_a_server_without_the_key() -> None:
    network = VirtualNetwork(make_server(rig_key=RigKey(bytes(32))))
    for camera_id in range(3):
        add_agent(network, camera_id)
    network.run(5.0)
    assert frames_of(network) == {}
    for agent in network.agents:
        assert agent.link.counters.frames == 0
        assert {type(event) for event in agent.events} == {Rejected}


def test_a_forger_who_reads_the_session_ids_ends_no_session_with_notices() -> None:
    network = make_rig(CLEAN, cameras=2)
    network.run(1.0)
    for agent in network.agents:
        assert agent.link.session is not None
        notice = encode_clear(*encode_body(UnknownSession()), agent.link.session.session_id)
        for k in range(200):
            agent.downlink.send(notice, network.now_ns + k * 10_000_000)
    network.server_events.clear()
    network.run(2.0)
    assert {camera_id: len(frames) for camera_id, frames in frames_of(network).items()} == {0: 60, 1: 60}
    assert [[type(event) for event in agent.events] for agent in network.agents] == [[Connected]] * 2


def test_everything_recorded_and_sent_again_changes_nothing() -> None:
    network = make_rig(CLEAN, cameras=2)
    recorded: list[tuple[int, bytes, Address]] = []
    for agent in network.agents:
        agent.uplink = RecordingLink(agent.address, recorded)
    network.run(2.0)
    network.strangers = [(now_ns + 2 * SECOND_NS, data, address) for now_ns, data, address in recorded]
    network.run(2.0)
    assert len(recorded) > 300
    assert {camera_id: len(frames) for camera_id, frames in frames_of(network).items()} == {0: 119, 1: 120}
    assert_delivered_frames_are_true(network)
    assert [[type(event) for event in agent.events] for agent in network.agents] == [[Connected]] * 2
    assert network.server is not None
    assert network.server.rejected["stale_hello"] == 2
    assert network.server.rejected["replayed"] > 20


class RecordingLink(LossyLink):
    """A clean link with a listener."""

    def __init__(self, address: Address, recorded: list[tuple[int, bytes, Address]]) -> None:
        super().__init__(1, CLEAN)
        self._address, self._recorded = address, recorded

    def send(self, datagram: bytes, now_ns: int) -> None:
        self._recorded.append((now_ns, datagram, self._address))
        super().send(datagram, now_ns)


def test_bursts_of_agents_with_different_clocks_take_turns_in_rig_time() -> None:
    network = make_rig(CLEAN, cameras=4)
    network.run(1.0)
    assert network.server is not None
    for slot in range(4):
        network.server.plan_stream(slot, StreamChoice(COLOR, DEPTH, FPS, slot, 4, 1_000_000, 0.8))
    network.run(1.0)
    for slot, agent in enumerate(network.agents):
        plan = agent.link.plan
        assert plan is not None
        # A moment of the plan's grid soon, by this agent's own clock, in true (which is rig) time:
        agent_ns, phase_ns = agent.clock.read(network.now_ns), plan.phase_ns - plan.offset_ns
        moment_ns = agent.clock.true_time(agent_ns + (phase_ns - agent_ns) % plan.step_ns)
        late_ns = (moment_ns - slot * 250_000 + 500_000) % 1_000_000 - 500_000
        assert abs(late_ns) < 50_000  # a fifth of a slot


@pytest.mark.parametrize("first_codec", [COLOR, COLOR + 1])
def test_a_change_of_codec_amid_the_stream_loses_no_frame(first_codec: int) -> None:
    codecs = (COLOR, COLOR + 1)
    network = VirtualNetwork(make_server(color_codecs=codecs))
    agent = add_agent(network, 0, color_codecs=codecs)

    def make_planned(sequence: int, agent_ns: int) -> EncodedFrame:
        plan = agent.link.plan
        codec_id = first_codec if plan is None else plan.color_codec
        assert codec_id is not None
        return make_frame(sequence, agent_ns, color=Payload(codec_id, b"pixels"))

    agent.make_frame = make_planned
    assert network.server is not None
    for codec_id in (*codecs, *codecs):
        network.run(1.0)
        network.server.plan_stream(0, StreamChoice(codec_id, DEPTH, FPS, 0, 1, 1_000_000, 0.8))
    network.run(1.0)
    frames = frames_of(network)[0]
    assert [frame.sequence for frame in frames] == list(
        range(frames[0].sequence, frames[0].sequence + len(frames))
    )
    assert len(frames) >= 5 * FPS - 2
    assert {frame.color.codec_id for frame in frames if frame.color is not None} == set(codecs)


def test_a_flood_of_garbage_beside_the_stream_changes_nothing() -> None:
    network = make_rig(CLEAN, cameras=2)
    network.run(0.5)
    chaos = random.Random(4)
    for k in range(600):
        data = chaos.choice(
            (b"", b"KR\x02\x10", b"KR\x02\x01", b"KR\x01\x01", b"KR\x02\x05")
        ) + chaos.randbytes(chaos.randint(0, 900))
        network.strangers.append((network.now_ns + k * 500_000, data, (f"198.51.100.{k % 250}", k)))
    network.server_events.clear()
    network.run(0.5)
    assert network.server is not None
    assert all(camera.counters.lost <= 1 for camera in network.server.cameras.values())
    assert {camera_id: len(frames) for camera_id, frames in frames_of(network).items()} == {0: 15, 1: 15}
    assert sum(network.server.rejected.values()) == 600


@pytest.mark.parametrize("step_s", [-3600.0, -15.0, 0.2, 1.5])
def test_a_step_of_an_agents_clock_is_noticed_and_no_frame_leaves_with_a_wrong_time(step_s: float) -> None:
    network = make_rig(Faults(jitter_ns=200_000), cameras=1)
    network.run(3.0)
    network.agents[0].clock.offset_ns += round(step_s * SECOND_NS)
    network.server_events.clear()
    network.run(1.0)
    assert network.server is not None
    counters = network.server.cameras[0].counters
    assert counters.clock_steps == 1
    assert 1 <= counters.untimed <= 4
    assert all(abs(error_ns) <= 4 * doubt_ns for error_ns, doubt_ns in clock_errors(network, 0))


def test_after_a_clock_step_longer_than_the_silence_the_agent_begins_anew() -> None:
    network = make_rig(CLEAN, cameras=1)
    network.run(1.0)
    network.agents[0].clock.offset_ns += 3600 * SECOND_NS
    network.run(1.0)
    assert [type(event) for event in network.agents[0].events] == [Connected, Disconnected, Connected]
    assert all(abs(error_ns) <= 4 * doubt_ns for error_ns, doubt_ns in clock_errors(network, 0))


def test_the_same_seed_gives_the_same_run() -> None:
    def run() -> list[tuple[int, int]]:
        network = make_rig(ROUGH, cameras=2)
        network.run(1.0)
        return [(frame.sequence, frame.timestamp_ns) for frame in frames_of(network)[1]]

    assert run() == run()
