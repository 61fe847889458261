"""Which durations are observed, and which of them count as recent."""

import pytest

from rig_protocol.frames import RgbdFrame
from rig_server.assembler import SetRecord
from rig_server.durations import (
    EXPOSURE_TO_RECEIVED,
    RECEIVED_TO_DECODED,
    RECEIVED_TO_DELIVERED,
    SPREAD,
    UNCERTAINTY,
    Durations,
    RecentDurations,
)

MS = 1_000_000
S = 1000 * MS


def test_a_frame_is_timed_from_exposure_over_its_last_datagram_to_the_decoded_images() -> None:
    durations = Durations()
    durations.frame_decoded(RgbdFrame(0, 1, 100 * MS, received_ns=131 * MS), 135 * MS)
    seen = durations.snapshot()
    assert (seen[EXPOSURE_TO_RECEIVED].count, seen[EXPOSURE_TO_RECEIVED].sum_ns) == (1, 31 * MS)
    assert (seen[RECEIVED_TO_DECODED].count, seen[RECEIVED_TO_DECODED].sum_ns) == (1, 4 * MS)


def test_a_set_is_timed_from_its_last_datagram() -> None:
    durations = Durations()
    durations.set_delivered(SetRecord(200 * MS, 26 * MS, (3,), 90_000, 188 * MS))
    sums = {name: seen.sum_ns for name, seen in durations.snapshot().items() if seen.count}
    assert sums == {RECEIVED_TO_DELIVERED: 12 * MS, SPREAD: 26 * MS, UNCERTAINTY: 90_000}


def test_what_crossed_no_network_has_no_latency() -> None:
    durations = Durations()
    durations.frame_decoded(RgbdFrame(0, 1, 100 * MS), 135 * MS)
    durations.set_delivered(SetRecord(200 * MS, 26 * MS, ()))
    assert {name for name, seen in durations.snapshot().items() if seen.count} == {SPREAD, UNCERTAINTY}


def test_what_was_slow_a_minute_ago_is_no_longer_recent() -> None:
    durations, recent = Durations(), RecentDurations()
    slow = SetRecord(500 * MS, 26 * MS, (), 90_000, 0)
    quick = SetRecord(2 * MS, 26 * MS, (), 90_000, 0)
    for second in range(60):
        for _ in range(30):
            durations.set_delivered(slow if second < 20 else quick)
        seen = recent.update(durations.snapshot(), second * S)[RECEIVED_TO_DELIVERED]
        if second == 10:
            assert seen.quantile_ns(0.99) == pytest.approx(500 * MS, rel=0.1)
    assert seen.count == 30 * 30
    assert seen.quantile_ns(0.99) == pytest.approx(2 * MS, rel=0.5)
