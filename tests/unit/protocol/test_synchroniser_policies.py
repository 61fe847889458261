"""The policies partial, strict and latest with cameras of different rates, in virtual time."""

from collections.abc import Iterable

import numpy as np
import pytest

from rig_protocol.frames import RgbdFrame
from rig_protocol.synchroniser import Synchroniser
from support.frame_streams import (
    DEADLINE_NS,
    LATENCY_NS,
    MS,
    PERIOD_NS,
    Arrival,
    Delivery,
    S,
    check_sets,
    frame,
    free_running,
    joined,
    run,
    stream,
)

SECONDS = 20
SLOW = 5  # the camera with a rate of its own


def mixed(seed: int, slow_fps: float, cameras: int = 6) -> list[Arrival]:
    """Free-running cameras at 30 fps, the last one at another rate."""
    rng = np.random.default_rng(seed)
    rates = [30.0] * (cameras - 1) + [slow_fps]
    return [item for i, fps in enumerate(rates) for item in free_running(rng, i, SECONDS, fps)]


def arrival_times(arrivals: Iterable[Arrival]) -> dict[tuple[int, int], int]:
    return {(item.camera_id, item.sequence): now_ns for now_ns, item in arrivals}


def waits_ns(delivered: Iterable[Delivery], arrivals: Iterable[Arrival]) -> list[int]:
    """How long every frame waited until it went out for the first time."""
    came = arrival_times(arrivals)
    first: dict[tuple[int, int], int] = {}
    for delivery in delivered:
        for item in delivery.frames:
            key = item.camera_id, item.sequence
            first.setdefault(key, delivery.now_ns - came[key])
    return list(first.values())


def idle_ns(delivered: Iterable[Delivery], arrivals: Iterable[Arrival]) -> list[int]:
    """How long every set waited after its last frame had come."""
    came = arrival_times(arrivals)
    return [d.now_ns - max(came[item.camera_id, item.sequence] for item in d.frames) for d in delivered]


@pytest.mark.parametrize("slow_fps", [24.0, 15.0, 10.0, 7.5, 1.0])
def test_partial_does_not_wait_for_a_slow_camera_between_its_frames(slow_fps: float) -> None:
    arrivals = mixed(3, slow_fps)
    synchroniser = joined(range(6))
    synchroniser.camera_joined(SLOW, slow_fps)
    delivered = run(synchroniser, arrivals)
    used = check_sets(delivered)
    settled = delivered[60:-10]
    assert len(delivered) == pytest.approx(30 * SECONDS, abs=10)
    assert {missing for d in settled for missing in d.panorama.missing} == {SLOW}
    assert sum(d.panorama.complete for d in settled) == pytest.approx(slow_fps / 30 * len(settled), abs=3)
    assert sum(camera_id == SLOW for camera_id, _ in used) >= slow_fps * SECONDS - 3
    assert max(idle_ns(settled, arrivals)) < PERIOD_NS
    assert np.percentile(idle_ns(settled, arrivals), 90) < MS


def test_partial_learns_that_a_camera_is_slower_than_it_says() -> None:
    arrivals = mixed(3, 15.0)
    delivered = run(joined(range(6)), arrivals)
    assert max(idle_ns(delivered[60:-10], arrivals)) < PERIOD_NS


def test_a_camera_that_becomes_faster_is_in_every_set_soon() -> None:
    arrivals = stream(0, 0, 120) + stream(1, 5 * MS, 120)
    arrivals += stream(2, 3 * MS, 30, 2 * PERIOD_NS) + stream(2, 60 * PERIOD_NS + 3 * MS, 60)
    delivered = run(joined(range(3)), arrivals)
    assert all(d.panorama.complete for d in delivered[-50:])


def test_a_camera_at_twice_the_rate_gives_every_set_one_frame_and_moves_no_other() -> None:
    arrivals = mixed(4, 60.0)
    delivered = run(joined(range(6)), arrivals)
    assert len(delivered) == pytest.approx(30 * SECONDS, abs=5)
    assert sum(not d.panorama.complete for d in delivered) <= 4


@pytest.mark.parametrize("slow_fps", [30.0, 24.0, 15.0, 10.0, 7.5, 1.0])
def test_strict_gives_complete_sets_at_the_rate_of_the_slowest_camera(slow_fps: float) -> None:
    arrivals = mixed(3, slow_fps)
    synchroniser = joined(range(6), policy="strict")
    synchroniser.camera_joined(SLOW, slow_fps)
    delivered = run(synchroniser, arrivals)
    check_sets(delivered)
    assert all(d.panorama.complete for d in delivered)
    assert len(delivered) == pytest.approx(slow_fps * SECONDS, abs=3)
    assert max(d.panorama.spread_ns for d in delivered[5:]) < PERIOD_NS + 3 * MS
    assert max(waits_ns(delivered, arrivals)) <= 1e9 / slow_fps + DEADLINE_NS


def test_strict_drops_a_set_that_lacks_a_frame_and_names_the_camera() -> None:
    arrivals = [item for i in range(4) for item in stream(i, i * 5 * MS, 30)]
    lost = [(now, f) for now, f in arrivals if not (f.camera_id == 2 and f.sequence in (10, 20))]
    synchroniser = joined(range(4), policy="strict")
    delivered = run(synchroniser, lost)
    assert len(delivered) == 28
    assert [record.missing for record in synchroniser.incomplete] == [(2,), (2,)]
    first = synchroniser.incomplete[0]
    assert first.decided_ns == 10 * PERIOD_NS + LATENCY_NS + PERIOD_NS + DEADLINE_NS
    assert (synchroniser.counters.incomplete, synchroniser.counters.skipped) == (2, 6)


def test_strict_gives_nothing_without_an_expected_camera_and_names_it_at_once() -> None:
    synchroniser = joined(range(3), policy="strict")
    synchroniser.camera_left(1)
    delivered = run(synchroniser, stream(0, 0, 10) + stream(2, 5 * MS, 10))
    assert delivered == []
    assert synchroniser.counters.incomplete == 10
    assert {record.missing for record in synchroniser.incomplete} == {(1,)}


def test_strict_names_a_silent_camera_even_when_the_deadline_is_longer_than_the_queues() -> None:
    synchroniser = joined(range(2), policy="strict", deadline_ns=10 * S)
    run(synchroniser, stream(0, 0, 60) + stream(1, 5 * MS, 20))
    assert synchroniser.counters.incomplete == 40
    assert {record.missing for record in synchroniser.incomplete} == {(1,)}


def test_strict_skips_what_a_narrow_limit_keeps_apart() -> None:
    synchroniser = joined(range(2), policy="strict", max_spread_ns=5 * MS)
    assert run(synchroniser, stream(0, 0, 10) + stream(1, 12 * MS, 10)) == []
    assert synchroniser.counters.skipped == 20


def test_latest_goes_out_when_every_camera_has_a_new_frame() -> None:
    synchroniser = joined(range(3), policy="latest")
    for camera_id in (0, 1):
        synchroniser.add(frame(camera_id, 10 * MS), 50 * MS)
        assert synchroniser.next_panorama(50 * MS) is None
    synchroniser.add(frame(2, 12 * MS), 60 * MS)
    panorama = synchroniser.next_panorama(60 * MS)
    assert panorama is not None
    assert panorama.complete


def test_latest_goes_out_one_period_after_its_first_frame_and_repeats_a_young_one() -> None:
    synchroniser = joined(range(2), policy="latest")
    run(synchroniser, stream(0, 0, 10) + stream(1, 5 * MS, 10))
    synchroniser.add(frame(0, 10 * PERIOD_NS, 10), now_ns := 10 * PERIOD_NS + LATENCY_NS)
    assert synchroniser.next_panorama(now_ns + PERIOD_NS - 1) is None
    panorama = synchroniser.next_panorama(now_ns + PERIOD_NS)
    assert panorama is not None
    repeated = panorama.frames[1]
    assert repeated is not None
    assert repeated.timestamp_ns == 5 * MS + 9 * PERIOD_NS
    assert synchroniser.counters.repeated == 1


def test_latest_does_not_repeat_a_frame_older_than_one_and_a_half_periods_of_its_camera() -> None:
    arrivals = stream(0, 0, 20) + stream(1, 5 * MS, 10)
    delivered = run(joined(range(2), policy="latest"), arrivals)
    assert [d.panorama.missing for d in delivered] == [()] * 11 + [(1,)] * 9


@pytest.mark.parametrize("slow_fps", [24.0, 15.0, 10.0, 7.5, 1.0])
def test_latest_gives_whole_sets_at_full_rate_and_no_frame_waits_longer_than_a_period(
    slow_fps: float,
) -> None:
    arrivals = mixed(3, slow_fps)
    synchroniser = joined(range(6), policy="latest")
    synchroniser.camera_joined(SLOW, slow_fps)
    delivered = run(synchroniser, arrivals)
    check_sets(delivered, repeats=True)
    settled = delivered[int(2 * 30 / slow_fps) : -5]
    assert len(delivered) == pytest.approx(30 * SECONDS, abs=6)
    assert sum(d.panorama.complete for d in settled) >= 0.99 * len(settled)
    assert max(waits_ns(delivered, arrivals)) <= PERIOD_NS + MS  # the measured period jitters
    assert synchroniser.counters.repeated == pytest.approx((30 - slow_fps) * SECONDS, rel=0.1, abs=30)


def test_latest_puts_no_set_before_the_last_one_when_a_camera_with_old_frames_joins() -> None:
    arrivals = stream(0, 0, 60) + stream(1, 10 * PERIOD_NS, 50, latency_ns=LATENCY_NS + 30 * MS)
    synchroniser = joined(range(2), policy="latest")
    delivered = run(synchroniser, arrivals)
    check_sets(delivered, repeats=True)
    assert sum(d.panorama.complete for d in delivered) >= 48


def test_latest_shows_nothing_of_a_camera_that_left() -> None:
    synchroniser = joined(range(2), policy="latest")
    run(synchroniser, stream(0, 0, 10) + stream(1, 5 * MS, 10))
    synchroniser.camera_left(1)
    synchroniser.add(frame(0, 10 * PERIOD_NS, 10), now_ns := 10 * PERIOD_NS + LATENCY_NS)
    panorama = synchroniser.next_panorama(now_ns)
    assert panorama is not None
    assert panorama.missing == (1,)


def test_a_single_camera_needs_nobody_else() -> None:
    for policy in ("partial", "strict", "latest"):
        synchroniser = Synchroniser([], DEADLINE_NS, policy=policy)
        synchroniser.camera_joined(7, 30.0)
        for k in range(5):
            synchroniser.add(RgbdFrame(7, k, k * PERIOD_NS), now_ns := k * PERIOD_NS + LATENCY_NS)
            assert synchroniser.next_panorama(now_ns) is not None
