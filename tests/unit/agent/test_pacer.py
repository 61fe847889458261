"""Rules of the pacer: spread, bounds, and what is dropped. Time is virtual."""

from itertools import pairwise

import pytest

from rig_agent.pacer import Pacer
from rig_protocol.datagram import DatagramBatch

INTERVAL_NS = 33_333_333
SIZE = 100


def frame(datagrams: int, fill: int = 0, last: int = SIZE) -> DatagramBatch:
    return DatagramBatch(bytes([fill]) * (SIZE * (datagrams - 1) + last), SIZE)


def make_pacer(spread: float = 0.8, burst: int = 8) -> Pacer:
    return Pacer(INTERVAL_NS, spread, burst)


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


def test_a_frame_that_never_began_is_replaced() -> None:
    pacer = make_pacer()
    pacer.submit(frame(160, fill=1), 0)
    pacer.sent(0, 0)
    pacer.submit(frame(160, fill=2), 10)
    assert {burst[0] for _, burst in drain(pacer, 10, 3 * INTERVAL_NS)} == {2}
    assert (pacer.counters.sent, pacer.counters.dropped) == (1, 1)


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
