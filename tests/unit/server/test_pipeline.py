"""The live pipeline over real loopback sockets, fed by the protocol's own agent link."""

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.events import Address, Outcome
from rig_protocol.frames import PanoramicFrame
from rig_server import Rig
from rig_server.config import CameraSettings, RigSettings, SynchroniserSettings
from rig_server.durations import RECEIVED_TO_DELIVERED, SPREAD, STAGES, UNCERTAINTY
from rig_server.exposition import DROPPED
from support.garbage import send_garbage
from support.small_agent import BAYER, FPS, RAW, SmallAgent

LOOPBACK = RigSettings(
    listen="127.0.0.1:0",
    insecure=True,
    expected_cameras=3,
    synchroniser=SynchroniserSettings(deadline_ms=500),
)


@pytest.fixture
def rig() -> Iterator[Rig]:
    with Rig.live(LOOPBACK) as running:
        yield running


def address_of(rig: Rig) -> Address:
    host, port = rig.place.removeprefix("UDP ").split(":")
    return host, int(port)


def next_set(rig: Rig, complete: bool) -> PanoramicFrame:
    """The next set of the wanted kind, within ten seconds."""
    until_s = time.monotonic() + 10
    while time.monotonic() < until_s:
        panorama = rig.next_panorama(0.5)
        if panorama is not None and panorama.complete == complete:
            return panorama
    raise AssertionError(f"no set with complete={complete} within ten seconds; {rig.status()}")


def test_frames_of_all_agents_arrive_decoded_in_complete_sets(rig: Rig) -> None:
    server = address_of(rig)
    with SmallAgent(0, server), SmallAgent(1, server), SmallAgent(2, server):
        rig.wait_for_cameras(10)
        panorama = next_set(rig, complete=True)
        while len(panorama.frames) < 3:  # sets of the first cameras, before the last one joined
            panorama = next_set(rig, complete=True)
    for camera_id, frame in panorama.frames.items():
        assert frame is not None
        assert frame.bayer is not None
        assert frame.raw is not None
        np.testing.assert_array_equal(frame.bayer, BAYER)
        np.testing.assert_array_equal(frame.raw, RAW + camera_id)
    assert panorama.spread_ns < 1e9 / FPS


def test_the_status_tells_rates_clock_error_and_temperature(rig: Rig) -> None:
    server = address_of(rig)
    with SmallAgent(0, server), SmallAgent(1, server), SmallAgent(2, server):
        rig.wait_for_cameras(10)
        rig.status()
        for _ in range(30):
            next_set(rig, complete=True)
        status = rig.status()
    assert status.connected == 3
    assert status.complete >= 30
    sets = status.complete + status.partial
    for name in (RECEIVED_TO_DELIVERED, SPREAD, UNCERTAINTY):
        assert abs(status.durations[name].count - sets) <= 2  # the rig does not stand still while it is read
    assert all(status.recent[stage].quantile_ns(0.5) is not None for stage in STAGES)
    assert status.queues.keys() == {"decoder", "synchroniser", "sets"}
    assert status.spread_ms is not None
    for camera in status.cameras:
        assert FPS / 5 < camera.fps < 1.4 * FPS  # a busy machine costs these agents frames
        assert camera.clock_error_us is not None
        assert camera.clock_error_us < 20_000
        assert camera.temperature_c == 50.0 + camera.camera_id
        assert camera.counters["frames"] == camera.frames
        assert camera.clock is not None


def test_the_description_holds_names_and_models_of_the_hellos(rig: Rig) -> None:
    server = address_of(rig)
    with SmallAgent(0, server), SmallAgent(1, server), SmallAgent(2, server):
        rig.wait_for_cameras(10)
        assert [camera.name for camera in rig.description.cameras] == ["pi-0", "pi-1", "pi-2"]
        assert rig.hellos[2].serial == "S2"


def test_cameras_that_do_not_come_are_named(rig: Rig) -> None:
    with (
        SmallAgent(1, address_of(rig)),
        pytest.raises(RigError, match=r"2 of 3 cameras have not come: cam00, cam02"),
    ):
        rig.wait_for_cameras(timeout_s=1.0)


def test_waiting_for_cameras_ends_at_once_when_receiving_has_failed(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rig._feed._receiver, "failure", OSError("the socket broke"))
    with pytest.raises(RigError, match=r"receiving stopped: .*the socket broke"):
        rig.wait_for_cameras(timeout_s=60)


def test_everything_that_is_lost_on_the_way_has_a_name(rig: Rig) -> None:
    status = rig.status()
    assert sum(status.rejected.values()) == 0
    assert status.dropped.keys() == DROPPED.keys() | {"frames not decoded in time"}, "metrics must tell all"
    assert status.dropped == {
        "incomplete sets": 0,
        "sets not taken": 0,
        "frames left out of sets": 0,
        "frames of implausible time": 0,
        "frames not decoded in time": 0,
        "datagrams by the kernel": 0,
        "answers that the network refused": 0,
    }


def test_a_stranger_is_refused_and_the_refusal_is_in_the_message() -> None:
    listed = LOOPBACK.model_copy(
        update={"expected_cameras": None, "cameras": (CameraSettings(id=0, name="door", serial="OTHER"),)}
    )
    with Rig.live(listed) as rig, SmallAgent(0, address_of(rig)), pytest.raises(RigError) as caught:
        rig.wait_for_cameras(timeout_s=1.0)
    assert "have not come: door" in str(caught.value)
    assert "refused 127.0.0.1" in str(caught.value)
    assert "OTHER" in str(caught.value)


def test_a_connected_camera_that_sends_no_frames_is_named_missing(rig: Rig) -> None:
    server = address_of(rig)
    with SmallAgent(0, server), SmallAgent(1, server), SmallAgent(2, server, silent=True):
        rig.wait_for_cameras(10)
        panorama = next_set(rig, complete=False)
    assert 2 in panorama.missing


def test_a_camera_that_leaves_and_comes_back_is_in_the_sets_again(rig: Rig) -> None:
    server = address_of(rig)
    with SmallAgent(0, server), SmallAgent(1, server):
        with SmallAgent(2, server):
            rig.wait_for_cameras(10)
            next_set(rig, complete=True)
        while 2 in next_set(rig, complete=True).frames:
            pass
        with SmallAgent(2, server):
            rig.wait_for_cameras(10)
            while 2 not in next_set(rig, complete=True).frames:
                pass


def test_garbage_is_counted_and_harms_nobody(rig: Rig) -> None:
    server = address_of(rig)
    rng = np.random.default_rng(3)
    with SmallAgent(0, server), SmallAgent(1, server), SmallAgent(2, server):
        rig.wait_for_cameras(10)
        send_garbage(rig, server, [rng.bytes(int(size)) for size in rng.integers(1, 1472, 200)])
        next_set(rig, complete=True)


def test_an_occupied_port_is_refused_with_what_to_do(rig: Rig) -> None:
    host, port = address_of(rig)
    with pytest.raises(RigError, match=f"UDP port {port} is in use"):
        Rig.open(f"udp://{host}:{port}", LOOPBACK)


def test_every_camera_does_what_it_is_told_and_the_answers_name_those_that_did_not(rig: Rig) -> None:
    server = address_of(rig)
    with SmallAgent(0, server) as first, SmallAgent(1, server) as second, SmallAgent(2, server):
        rig.wait_for_cameras(10)
        answers = rig.control(None, "tilt_deg", 5)
        assert {i: one.outcome for i, one in answers.items()} == dict.fromkeys(range(3), Outcome.DONE)
        [refused] = rig.control(1, "sing", "louder").values()
        assert (refused.outcome, refused.text) == (Outcome.REFUSED, "it has depth")
        [absent] = rig.control(7, "led", "green").values()
        assert (absent.outcome, absent.text) == (Outcome.REFUSED, "it is not connected")
        with pytest.raises(ConfigurationError, match="this control cannot be sent"):
            rig.control(None, "", True)
    assert first.done == second.done == [("tilt_deg", 5.0)]


def test_an_agent_that_leaves_before_it_answers_leaves_nobody_waiting(rig: Rig) -> None:
    server = address_of(rig)
    with SmallAgent(0, server) as agent:
        while 0 not in rig.hellos:
            rig.next_panorama(0.05)
        agent.deaf = True
        with ThreadPoolExecutor(1) as operator:
            asked = operator.submit(rig.control, 0, "restart", True)
            while not agent.ignored:
                rig.next_panorama(0.05)
            agent.leave()
            [answer] = asked.result(20).values()
    assert answer.outcome is Outcome.UNANSWERED
