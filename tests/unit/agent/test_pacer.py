"""Rules of the pacer: spread, bounds, and what is dropped. Time is virtual."""

from itertools import pairwise

import pytest

from rig_agent.pacer import BurstGrid, Pacer
from rig_protocol.datagram import DatagramBatch

INTERVAL_NS = 33_333_333
SIZE = 100
STEP_NS = 1_000_000


def frame(datagrams: int, fill: int = 0, last: int = SIZE) -> DatagramBatch:
    return DatagramBatch(bytes([fill]) * (SIZE * (datagrams - 1) + last), SIZE)


def make_pacer(spread: float = 0.8, burst: int = 8) -> Pacer[DatagramBatch]:
    """Its frames are cut already."""
    return Pacer(INTERVAL_NS, spread, burst, lambda batch, _: batch)


def drain(pacer: Pacer, now_ns: int, until_ns: int, *, lateness_ns: int = 0) -> list[tuple[int, bytes]]:
    """Serve the pacer as its shell does, waking `lateness_ns` after every time-out: (time, bytes) a burst."""
    bursts = []
    while (due_ns := pacer.next_timeout_ns()) is not None and due_ns + lateness_ns <= until_ns:
        now_ns = max(now_ns, due_ns + lateness_ns)
        burst = pacer.next_burst(now_ns)
        if burst is not None:
            bursts.append((now_ns, bytes(burst.part(0, len(burst)))))
            pacer.sent(len(burst), now_ns)
    return bursts


def test_every_datagram_is_sent_once_in_order() -> None:
    data = bytes(range(250)) * 10 + b"tail"
    pacer = make_pacer()
    pacer.submit(DatagramBatch(data, SIZE), 0)
    assert b"".join(burst for _, burst in drain(pacer, 0, INTERVAL_NS)) == data
    assert pacer.next_timeout_ns() is None
    assert pacer.counters.sent == 1


def test_bursts_are_evenly_spread_over_the_share_of_the_interval() -> None:
    pacer = make_pacer(spread=0.8, burst=8)
    pacer.submit(frame(160), 0)
    times = [time_ns for time_ns, _ in drain(pacer, 0, INTERVAL_NS)]
    step_ns = 0.8 * INTERVAL_NS / 20
    assert times == pytest.approx([k * step_ns for k in range(20)], abs=20)


def test_no_burst_in_time_exceeds_its_bound() -> None:
    pacer = make_pacer(burst=8)
    pacer.submit(frame(163, last=1), 0)
    sizes = [len(burst) for _, burst in drain(pacer, 0, INTERVAL_NS)]
    assert max(sizes) == 8 * SIZE
    assert sum(sizes) == 162 * SIZE + 1


def test_a_frame_of_one_datagram_goes_at_once() -> None:
    pacer = make_pacer()
    pacer.submit(frame(1), 5)
    assert [time_ns for time_ns, _ in drain(pacer, 5, 5)] == [5]


def test_a_spread_of_zero_sends_at_once() -> None:
    pacer = make_pacer(spread=0)
    pacer.submit(frame(100), 0)
    assert sum(len(burst) for _, burst in drain(pacer, 0, 1000)) == 100 * SIZE


def test_nothing_is_due_before_its_time() -> None:
    pacer = make_pacer()
    pacer.submit(frame(160), 0)
    pacer.sent(8, 0)
    due_ns = pacer.next_timeout_ns()
    assert due_ns is not None
    assert pacer.next_burst(due_ns - 1) is None
    assert pacer.next_burst(due_ns) is not None


def test_a_late_shell_keeps_the_schedule() -> None:
    pacer = make_pacer()
    pacer.submit(frame(160), 0)
    times = [time_ns for time_ns, _ in drain(pacer, 0, INTERVAL_NS, lateness_ns=100_000)]
    assert times[-1] == pytest.approx(0.76 * INTERVAL_NS + 100_000, abs=20)


def test_catching_up_after_a_stall_is_quick_but_bounded() -> None:
    pacer = make_pacer(burst=8)
    pacer.submit(frame(160), 0)
    drain(pacer, 0, 0)
    stalled_until_ns = INTERVAL_NS // 2
    caught_up = drain(pacer, stalled_until_ns, stalled_until_ns + INTERVAL_NS // 10)
    step_ns = 0.8 * INTERVAL_NS / 20
    assert max(len(burst) for _, burst in caught_up) == 4 * 8 * SIZE
    assert min(after - before for (before, _), (after, _) in pairwise(caught_up)) >= step_ns // 2
    sent = 8 * SIZE + sum(len(burst) for _, burst in caught_up)
    assert sent >= 160 * SIZE * (0.6 / 0.8)  # as far as if nothing had happened


def test_a_frame_begun_is_finished_before_the_newer_one() -> None:
    pacer = make_pacer()
    pacer.submit(frame(160, fill=1), 0)
    drain(pacer, 0, INTERVAL_NS // 2)
    pacer.submit(frame(160, fill=2), INTERVAL_NS // 2)
    fills = [burst[0] for _, burst in drain(pacer, INTERVAL_NS // 2, 3 * INTERVAL_NS)]
    assert fills == sorted(fills)
    assert fills.count(2) == 20
    assert (pacer.counters.sent, pacer.counters.dropped) == (2, 0)


def test_the_newest_frame_replaces_one_that_waits() -> None:
    pacer = make_pacer()
    pacer.submit(frame(160, fill=1), 0)
    drain(pacer, 0, 0)
    pacer.submit(frame(160, fill=2), 10)
    pacer.submit(frame(160, fill=3), 20)
    fills = {burst[0] for _, burst in drain(pacer, 20, 3 * INTERVAL_NS)}
    assert fills == {1, 3}
    assert (pacer.counters.sent, pacer.counters.dropped) == (2, 1)


def test_a_frame_is_cut_when_its_turn_comes_and_never_when_it_gives_way() -> None:
    """What is cut has a number, which the server would miss."""
    cut: list[tuple[str, int]] = []

    def cutting(name: str, now_ns: int) -> DatagramBatch:
        cut.append((name, now_ns))
        return frame(8)

    pacer = Pacer(INTERVAL_NS, 0.8, 8, cutting)
    pacer.grid = BurstGrid(STEP_NS, 0, 0.8)
    for k, name in enumerate(("first", "second", "third")):
        pacer.submit(name, k + 1)
    drain(pacer, 3, 3 * INTERVAL_NS)
    assert [name for name, _ in cut] == ["first", "third"]
    assert cut[1][1] >= STEP_NS
    assert (pacer.counters.sent, pacer.counters.dropped) == (2, 1)


def test_a_frame_for_which_nobody_listens_any_more_is_no_hindrance() -> None:
    pacer = Pacer[str](INTERVAL_NS, 0.8, 8, lambda name, _: frame(8) if name == "heard" else None)
    for name in ("unheard", "heard", "unheard", "unheard"):
        pacer.submit(name, 0)
    drain(pacer, 0, INTERVAL_NS)
    assert pacer.counters.sent == 1
    assert pacer.next_timeout_ns() is None


def test_a_frame_stuck_for_two_intervals_is_given_up_for_a_newer_one() -> None:
    pacer = make_pacer()
    pacer.submit(frame(160, fill=1), 0)
    pacer.sent(8, 0)
    late_ns = 2 * INTERVAL_NS + 1
    pacer.submit(frame(160, fill=2), late_ns)
    assert {burst[0] for _, burst in drain(pacer, late_ns, 4 * INTERVAL_NS)} == {2}
    assert (pacer.counters.sent, pacer.counters.dropped) == (1, 1)


def test_what_the_network_did_not_take_is_offered_again_later() -> None:
    pacer = make_pacer()
    pacer.submit(frame(160), 0)
    pacer.sent(3, 0)
    due_ns = pacer.next_timeout_ns()
    assert due_ns is not None
    assert due_ns > 0
    assert sum(len(burst) for _, burst in drain(pacer, due_ns, INTERVAL_NS)) == 157 * SIZE


def test_clearing_counts_what_was_unsent() -> None:
    pacer = make_pacer()
    pacer.submit(frame(160), 0)
    drain(pacer, 0, 0)
    pacer.submit(frame(160), 1)
    pacer.clear()
    assert pacer.next_timeout_ns() is None
    assert pacer.counters.dropped == 2


# ---- the server's grid


GRID = BurstGrid(STEP_NS, 250_000, 0.8)


@pytest.mark.parametrize("now_ns", [0, 249_999, 250_000, 250_001, 10**15 + 3, -5])
def test_the_next_moment_of_a_grid_is_the_first_from_now_on(now_ns: int) -> None:
    moment_ns = GRID.next_ns(now_ns)
    assert now_ns <= moment_ns < now_ns + STEP_NS
    assert moment_ns % STEP_NS == 250_000


@pytest.mark.parametrize("start_ns", [0, 123_456, 10**12 + 999_999])
def test_bursts_leave_at_the_moments_of_the_grid_over_the_share_of_the_interval(start_ns: int) -> None:
    pacer = make_pacer(spread=0.8)
    pacer.grid = GRID
    pacer.submit(frame(160), start_ns)
    bursts = drain(pacer, start_ns, start_ns + INTERVAL_NS)
    assert {time_ns % STEP_NS for time_ns, _ in bursts} == {250_000}
    assert sum(len(burst) for _, burst in bursts) == 160 * SIZE
    assert all(after - before == STEP_NS for (before, _), (after, _) in pairwise(bursts))
    assert bursts[-1][0] <= start_ns + STEP_NS + 0.8 * INTERVAL_NS
    assert max(len(burst) for _, burst in bursts) == 7 * SIZE  # 160 in 26 steps


def test_the_bursts_of_agents_in_other_slots_never_coincide() -> None:
    times = []
    for slot in range(12):
        pacer = make_pacer()
        pacer.grid = BurstGrid(STEP_NS, slot * STEP_NS // 12, 0.8)
        pacer.submit(frame(160), slot * 1_234_567)
        times += [time_ns for time_ns, _ in drain(pacer, slot * 1_234_567, 10**9)]
    assert min(after - before for before, after in pairwise(sorted(times))) >= STEP_NS // 13


def test_a_frame_of_many_datagrams_takes_larger_bursts_not_more_time() -> None:
    pacer = make_pacer()
    pacer.grid = GRID
    pacer.submit(frame(1600), 0)
    bursts = drain(pacer, 0, INTERVAL_NS)
    assert sum(len(burst) for _, burst in bursts) == 1600 * SIZE


def test_a_step_longer_than_the_share_of_the_interval_sends_a_frame_in_one_burst() -> None:
    pacer = make_pacer()
    pacer.grid = BurstGrid(100_000_000, 5, 0.8)
    pacer.submit(frame(20), 0)
    assert [len(burst) for _, burst in drain(pacer, 0, 10**9)] == [20 * SIZE]


def test_a_new_grid_counts_from_the_next_frame_on() -> None:
    pacer = make_pacer()
    pacer.submit(frame(160), 0)
    before = drain(pacer, 0, INTERVAL_NS // 2)
    pacer.grid = GRID
    after = drain(pacer, INTERVAL_NS // 2, INTERVAL_NS)
    assert len(before) + len(after) == 20
    pacer.submit(frame(160), INTERVAL_NS)
    assert {time_ns % STEP_NS for time_ns, _ in drain(pacer, INTERVAL_NS, 2 * INTERVAL_NS)} == {250_000}
    pacer.grid = None
    pacer.submit(frame(160), 2 * INTERVAL_NS)
    assert len(drain(pacer, 2 * INTERVAL_NS, 3 * INTERVAL_NS)) == 20


def test_a_spread_of_zero_knows_no_grid() -> None:
    pacer = make_pacer(spread=0)
    pacer.grid = GRID
    pacer.submit(frame(100), 0)
    assert sum(len(burst) for _, burst in drain(pacer, 0, 1000)) == 100 * SIZE


# ---- resends


def resends(pacer: Pacer, now_ns: int, until_ns: int) -> list[tuple[int, int]]:
    """What is sent again, as (time, datagrams)."""
    sent = []
    while (due_ns := pacer.next_timeout_ns()) is not None and due_ns <= until_ns:
        now_ns = max(now_ns, due_ns)
        while (batch := pacer.next_resend(now_ns)) is not None:
            sent.append((now_ns, len(batch)))
        if (burst := pacer.next_burst(now_ns)) is not None:
            pacer.sent(len(burst), now_ns)
    return sent


def test_a_resend_leaves_at_once_ahead_of_what_is_due_later() -> None:
    pacer = make_pacer()
    pacer.submit(frame(160), 0)
    drain(pacer, 0, 0)
    pacer.resend(frame(2))
    assert pacer.next_timeout_ns() == 0
    assert resends(pacer, 100, 200) == [(100, 2)]


def test_resends_leave_at_most_a_burst_a_step() -> None:
    pacer = make_pacer(spread=0.8, burst=8)
    pacer.submit(frame(160), 0)
    step_ns = 0.8 * INTERVAL_NS / 20
    pacer.resend(frame(30))
    for _ in range(10):
        pacer.resend(frame(1))
    sent = resends(pacer, 0, INTERVAL_NS)
    assert sum(count for _, count in sent) == 40
    for start_ns, _ in sent:
        window = sum(count for time_ns, count in sent if start_ns <= time_ns < start_ns + 0.99 * step_ns)
        assert window <= 8


def test_resends_do_not_hold_up_the_frame() -> None:
    pacer = make_pacer()
    pacer.submit(frame(160), 0)
    for _ in range(200):
        pacer.resend(frame(8))
    resends(pacer, 0, INTERVAL_NS)
    assert pacer.counters.sent == 1


def test_resends_before_any_frame_and_after_the_last_one_leave_too() -> None:
    pacer = make_pacer()
    pacer.resend(frame(20))
    assert sum(count for _, count in resends(pacer, 0, INTERVAL_NS)) == 20


def test_every_datagram_of_a_resend_is_sent_once_in_order() -> None:
    pacer = make_pacer()
    data = bytes(range(250)) * 10 + b"tail"
    pacer.resend(DatagramBatch(data, SIZE))
    sent, now_ns = b"", 0
    while (due_ns := pacer.next_timeout_ns()) is not None:
        now_ns = max(now_ns, due_ns)
        batch = pacer.next_resend(now_ns)
        assert batch is not None
        sent += bytes(batch.part(0, len(batch)))
    assert sent == data


def test_resends_that_wait_are_bounded_and_the_oldest_go() -> None:
    pacer = make_pacer()
    for k in range(2000):
        pacer.resend(frame(1, fill=k % 256))
    fills = []
    while (due_ns := pacer.next_timeout_ns()) is not None:
        batch = pacer.next_resend(due_ns)
        assert batch is not None
        fills.append(batch[0][0])
    assert fills == [k % 256 for k in range(2000 - 512, 2000)]


def test_clearing_forgets_the_resends() -> None:
    pacer = make_pacer()
    pacer.resend(frame(3))
    pacer.clear()
    assert pacer.next_timeout_ns() is None


def test_it_is_known_how_much_of_a_frame_has_left() -> None:
    pacer = make_pacer()
    first, second = frame(160), frame(160)
    pacer.submit(first, 0)
    assert pacer.sent_of(first) == 0
    pacer.sent(8, 0)
    assert pacer.submit(second, 1) is None
    assert pacer.sent_of(first) == 8
    drain(pacer, 2, 2 * INTERVAL_NS)
    assert [pacer.sent_of(one) for one in (first, second)] == [160, 160]


def test_a_frame_that_got_stuck_is_told_as_given_up() -> None:
    pacer = make_pacer()
    first, second = frame(160), frame(160)
    pacer.submit(first, 0)
    pacer.sent(8, 0)
    assert pacer.submit(second, 2 * INTERVAL_NS + 1) is first
