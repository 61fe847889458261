"""Rules of the synchroniser, in virtual time."""

from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig_protocol.camera_queue import MAX_PENDING
from rig_protocol.frames import RgbdFrame
from rig_protocol.synchroniser import Policy, Synchroniser
from support.frame_streams import (
    DEADLINE_NS,
    MS,
    PERIOD_NS,
    Arrival,
    Happening,
    S,
    check_sets,
    frame,
    joined,
    run,
    stream,
)


def tightest_spread_ns(phases_ns: Iterable[int]) -> int:
    """One period less the widest gap between phases on the circle."""
    sorted_ns = sorted(phase % PERIOD_NS for phase in phases_ns)
    gaps = np.diff([*sorted_ns, sorted_ns[0] + PERIOD_NS])
    return int(PERIOD_NS - gaps.max())


def test_a_set_is_complete_as_soon_as_every_connected_camera_has_its_frame() -> None:
    synchroniser = joined([0, 1, 2])
    for camera_id in (0, 1):
        synchroniser.add(frame(camera_id, 10 * MS), 50 * MS)
        assert synchroniser.next_panorama(50 * MS) is None
    synchroniser.add(frame(2, 12 * MS), 60 * MS)
    panorama = synchroniser.next_panorama(60 * MS)
    assert panorama is not None
    assert panorama.complete
    assert panorama.spread_ns == 2 * MS
    assert panorama.timestamp_ns == 10_666_666
    assert synchroniser.counters.complete == 1


def test_a_set_goes_out_partial_one_period_and_the_deadline_after_its_first_frame() -> None:
    synchroniser = joined([0, 1, 2])
    synchroniser.add(frame(0, 10 * MS), 50 * MS)
    synchroniser.add(frame(2, 11 * MS), 52 * MS)
    due_ns = synchroniser.next_timeout_ns()
    assert due_ns == 50 * MS + PERIOD_NS + DEADLINE_NS
    assert synchroniser.next_panorama(due_ns - 1) is None
    panorama = synchroniser.next_panorama(due_ns)
    assert panorama is not None
    assert panorama.missing == (1,)
    assert synchroniser.next_timeout_ns() is None
    assert synchroniser.counters.partial == 1


def test_a_frame_that_comes_after_its_set_is_counted_late() -> None:
    synchroniser = joined([0, 1])
    synchroniser.add(frame(0, 10 * MS), 50 * MS)
    assert synchroniser.next_panorama(50 * MS + PERIOD_NS + DEADLINE_NS) is not None
    synchroniser.add(frame(1, 9 * MS), 200 * MS)
    assert synchroniser.next_panorama(10**12) is None
    assert synchroniser.counters.late == synchroniser.late(1) == 1


def test_a_frame_from_the_future_is_refused_and_counted() -> None:
    synchroniser = joined([0])
    synchroniser.add(frame(0, 5_000 * MS), 10 * MS)
    assert synchroniser.next_panorama(10**12) is None
    assert synchroniser.counters.implausible == 1


def test_a_camera_that_left_is_named_missing_but_not_waited_for() -> None:
    synchroniser = joined([0, 1])
    synchroniser.camera_left(1)
    synchroniser.add(frame(0, 10 * MS), 50 * MS)
    panorama = synchroniser.next_panorama(50 * MS)
    assert panorama is not None
    assert panorama.missing == (1,)


def test_an_expected_camera_that_never_joined_is_named_missing_but_not_waited_for() -> None:
    synchroniser = Synchroniser([0, 7], deadline_ns=DEADLINE_NS)
    synchroniser.camera_joined(0, 30.0)
    synchroniser.add(frame(0, 10 * MS), 50 * MS)
    panorama = synchroniser.next_panorama(50 * MS)
    assert panorama is not None
    assert panorama.missing == (7,)


def test_a_camera_that_joins_an_open_rig_is_in_the_sets_from_then_on() -> None:
    synchroniser = joined([])
    synchroniser.camera_joined(3, 30.0)
    synchroniser.camera_joined(5, 30.0)
    delivered = run(synchroniser, stream(3, 0, 20) + stream(5, 7 * MS, 20))
    assert all(panorama.complete and set(panorama.frames) == {3, 5} for _, panorama in delivered)
    assert len(delivered) == 20


def test_cameras_that_start_at_different_times_end_up_in_complete_sets_without_lag() -> None:
    synchroniser = joined(range(3))
    starts = {0: 0, 1: 5 * PERIOD_NS + 3 * MS, 2: 9 * PERIOD_NS + 11 * MS}
    arrivals = [item for i, start in starts.items() for item in stream(i, start, 60)]
    delivered = run(synchroniser, arrivals)
    settled = [(now, p) for now, p in delivered if 15 * PERIOD_NS < p.timestamp_ns < 60 * PERIOD_NS]
    assert len(settled) == pytest.approx(45, abs=1)
    assert all(panorama.complete for _, panorama in settled)
    assert all(now - panorama.timestamp_ns < 40 * MS + PERIOD_NS for now, panorama in settled)


@pytest.mark.parametrize("seed", range(8))
def test_twelve_random_phases_give_complete_sets_at_the_tightest_spread(seed: int) -> None:
    rng = np.random.default_rng(seed)
    phases = rng.integers(0, PERIOD_NS, 12).tolist()
    arrivals = [item for i, phase in enumerate(phases) for item in stream(i, phase, 60)]
    delivered = [panorama for _, panorama in run(joined(range(12)), arrivals)]
    settled = delivered[3:-3]
    assert len(settled) >= 60 - 8
    assert all(panorama.complete for panorama in settled)
    # The hysteresis of the cut is 5 % of a period.
    assert max(p.spread_ns for p in settled) <= tightest_spread_ns(phases) + 0.05 * PERIOD_NS


def test_the_expected_spread_of_twelve_free_running_kinects_is_25_to_28_ms() -> None:
    rng = np.random.default_rng(7)
    means = []
    for _ in range(30):
        phases = rng.integers(0, PERIOD_NS, 12).tolist()
        arrivals = [item for i, phase in enumerate(phases) for item in stream(i, phase, 12)]
        panoramas = [panorama for _, panorama in run(joined(range(12)), arrivals) if panorama.complete]
        means.append(panoramas[-1].spread_ns / MS)
    assert 23 < np.mean(means) < 28


def test_a_camera_that_slides_by_a_frame_costs_one_frame_of_itself() -> None:
    fast_ns = PERIOD_NS - 100_000  # gains a period in 333 frames
    arrivals = stream(0, 0, 600) + stream(1, 10 * MS, 600) + stream(2, 20 * MS, 602, fast_ns)
    synchroniser = joined(range(3))
    delivered = [panorama for _, panorama in run(synchroniser, arrivals)]
    steady = delivered[2:-4]
    assert sum(not panorama.complete for panorama in steady) == 0
    assert max(panorama.spread_ns for panorama in steady) < PERIOD_NS
    assert synchroniser.counters.skipped <= 6


def test_a_slow_camera_is_missing_from_one_set_each_time_it_slides_by_a_frame() -> None:
    slow_ns = PERIOD_NS + 100_000
    arrivals = stream(0, 0, 600) + stream(1, 10 * MS, 600) + stream(2, 20 * MS, 598, slow_ns)
    delivered = [panorama for _, panorama in run(joined(range(3)), arrivals)]
    steady = delivered[2:-4]
    assert [p.missing for p in steady if not p.complete] == [(2,)] * sum(not p.complete for p in steady)
    assert 1 <= sum(not panorama.complete for panorama in steady) <= 3


def test_when_a_camera_leaves_the_others_find_their_own_tightest_set() -> None:
    arrivals = stream(0, 0, 100) + stream(1, 10 * MS, 160) + stream(2, 24 * MS, 160)
    leaves_ns = 100 * PERIOD_NS + 40 * MS
    delivered = run(joined(range(3)), arrivals, [(leaves_ns, lambda s: s.camera_left(0))])
    assert delivered[80].panorama.spread_ns == PERIOD_NS - 14 * MS
    assert all(panorama.spread_ns == 14 * MS for _, panorama in delivered[120:-3])


def test_a_lost_frame_leaves_one_partial_set_and_the_next_sets_complete() -> None:
    arrivals = [item for i in range(4) for item in stream(i, i * 5 * MS, 30)]
    lost = [(now, f) for now, f in arrivals if not (f.camera_id == 2 and f.sequence == 10)]
    delivered = [panorama for _, panorama in run(joined(range(4)), lost)]
    assert [panorama.missing for panorama in delivered if not panorama.complete] == [(2,)]
    assert len(delivered) == 30


def test_a_narrow_spread_limit_splits_what_does_not_fit() -> None:
    arrivals = stream(0, 0, 10) + stream(1, 12 * MS, 10)
    delivered = [p for _, p in run(joined(range(2), max_spread_ns=5 * MS), arrivals)]
    assert all(panorama.spread_ns <= 5 * MS for panorama in delivered)
    assert sum(len(p.frames) - len(p.missing) for p in delivered) == 20


def test_a_silent_camera_bounds_the_queues_and_does_not_stop_the_sets() -> None:
    synchroniser = joined(range(2), deadline_ns=10_000 * MS)
    delivered = run(synchroniser, stream(0, 0, 20), until_ns=0)
    assert len(delivered) == 20 - MAX_PENDING + 1
    assert synchroniser.counters.skipped == 0


def test_frames_that_nobody_collects_are_bounded_and_counted() -> None:
    synchroniser = joined([0, 1])
    for now_ns, item in stream(0, 0, 100):
        synchroniser.add(item, now_ns)
    assert synchroniser.counters.skipped == 100 - MAX_PENDING


def test_a_set_states_the_largest_uncertainty_of_its_frames() -> None:
    synchroniser = joined(range(3))
    for camera_id, uncertainty_ns in enumerate((20_000, 90_000, 40_000)):
        synchroniser.add(RgbdFrame(camera_id, 0, 10 * MS, uncertainty_ns), 50 * MS)
    panorama = synchroniser.next_panorama(50 * MS)
    assert panorama is not None
    assert panorama.uncertainty_ns == 90_000


def test_a_camera_that_is_connected_but_silent_delays_the_sets_for_a_second_at_most() -> None:
    arrivals = stream(0, 0, 90) + stream(1, 5 * MS, 90) + stream(2, 10 * MS, 20)
    delivered = run(joined(range(3)), arrivals)
    assert len(delivered) == 90
    assert all(d.now_ns - max(f.timestamp_ns for f in d.frames) == 40 * MS for d in delivered[55:])


def test_a_silent_camera_that_delivers_again_is_waited_for_again() -> None:
    arrivals = stream(0, 0, 90) + stream(1, 60 * PERIOD_NS + 10 * MS, 30)
    delivered = run(joined(range(2)), arrivals)
    assert [panorama.complete for _, panorama in delivered[-29:]] == [True] * 29


def test_one_frame_from_ahead_of_time_costs_no_other_camera_its_frames() -> None:
    arrivals = [item for i in range(3) for item in stream(i, i * MS, 60)]
    ahead_ns = (40 * MS, 900 * MS, 3600 * S)
    mad = [(S // 2, frame(3, S // 2 + ahead, k)) for k, ahead in enumerate(ahead_ns)]
    synchroniser = joined(range(3))
    check_sets(run(synchroniser, arrivals + mad))
    assert synchroniser.counters.implausible == 2
    assert synchroniser.counters.late + synchroniser.counters.skipped <= 6


events = st.tuples(
    st.integers(0, 4),  # camera
    st.integers(0, 1_000),  # exposure, ms
    st.integers(-80, 400),  # delay, ms: negative is a clock ahead of the rig's
    st.sampled_from(["frame"] * 8 + ["join", "leave"]),
)


@pytest.mark.parametrize("policy", ["partial", "strict", "latest"])
@settings(max_examples=100, deadline=None)
@given(
    st.lists(events, max_size=120),
    st.sets(st.integers(0, 4)),
    st.sampled_from([None, 8 * MS]),
    st.sampled_from([1, DEADLINE_NS, 2 * S]),
)
def test_every_frame_is_used_once_or_counted_and_sets_keep_the_order_of_time_whatever_happens(
    policy: Policy,
    raw: list[tuple[int, int, int, str]],
    absent: set[int],
    limit_ns: int | None,
    deadline_ns: int,
) -> None:
    synchroniser = Synchroniser(range(4), deadline_ns, limit_ns, policy=policy)
    for camera_id in set(range(5)) - absent:
        synchroniser.camera_joined(camera_id, 30.0)
    arrivals: list[Arrival] = []
    happenings: list[Happening] = []
    for k, (camera_id, exposure, delay, kind) in enumerate(raw):
        now_ns = max(0, (exposure + delay) * MS)
        if kind == "frame":
            arrivals.append((now_ns, frame(camera_id, exposure * MS, k)))
        elif kind == "join":
            happenings.append((now_ns, lambda s, i=camera_id: s.camera_joined(i, 30.0)))
        else:
            happenings.append((now_ns, lambda s, i=camera_id: s.camera_left(i)))
    delivered = run(synchroniser, arrivals, happenings)
    used = check_sets(delivered, repeats=policy == "latest")
    counters = synchroniser.counters
    assert len(used) + counters.late + counters.skipped + counters.implausible == len(arrivals)
    assert sum(synchroniser.late(camera_id) for camera_id in range(5)) == counters.late
    assert counters.complete + counters.partial == len(delivered)
    assert policy == "latest" or counters.repeated == 0
    assert policy != "strict" or counters.partial == 0
    for _, panorama in delivered:
        times = [f.timestamp_ns for f in panorama.frames.values() if f is not None]
        assert panorama.spread_ns == max(times) - min(times)
        assert panorama.spread_ns <= (limit_ns or 1_000 * MS)
        assert set(range(4)) <= set(panorama.frames)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(0, PERIOD_NS - 1), min_size=2, max_size=12),
    st.sets(st.tuples(st.integers(0, 11), st.integers(0, 29))),
    st.integers(0, 2**32 - 1),
)
def test_no_set_is_wider_than_one_frame_period_under_loss_and_jitter(
    phases: list[int], lost: set[tuple[int, int]], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    arrivals = [
        (now + int(rng.integers(0, 30 * MS)), f)
        for i, phase in enumerate(phases)
        for now, f in stream(i, phase, 30)
        if (i, f.sequence) not in lost
    ]
    for _, panorama in run(joined(range(len(phases))), arrivals):
        assert panorama.spread_ns <= PERIOD_NS


@pytest.mark.parametrize("policy", ["partial", "strict", "latest"])
def test_sets_go_on_at_once_when_the_rig_clock_is_set_back_an_hour(policy: Policy) -> None:
    synchroniser = Synchroniser(range(2), deadline_ns=DEADLINE_NS, policy=policy)
    for camera_id in range(2):
        synchroniser.camera_joined(camera_id, 30.0)
    hour_ns, interval_ns = 3_600 * 10**9, 33_333_333
    for start_ns in (2 * hour_ns, hour_ns):
        whole = []
        for k in range(5):
            time_ns = start_ns + k * interval_ns
            for camera_id in range(2):
                synchroniser.add(
                    RgbdFrame(camera_id, k, time_ns + camera_id * 1_000_000), time_ns + 5_000_000
                )
            while (panorama := synchroniser.next_panorama(time_ns + 5_000_000)) is not None:
                whole.append(panorama.complete)
    assert len(whole) >= 4
    assert all(whole[-3:])
