from dataclasses import replace
from itertools import pairwise

import pytest

from rig_protocol.testing import AgentClock, Faults, LossyLink

CLEAN = Faults(delay_ns=1000)
DATAGRAMS = [bytes((k % 256, k // 256)) * 20 for k in range(2000)]
INTERVAL_NS = 10_000


def carried(faults: Faults, seed: int = 3) -> tuple[list[bytes], LossyLink]:
    """What comes out when datagrams go in at a steady pace."""
    link = LossyLink(seed, faults)
    for k, datagram in enumerate(DATAGRAMS):
        link.send(datagram, k * INTERVAL_NS)
    return list(link.arrivals(10**12)), link


def test_a_clean_link_only_delays() -> None:
    link = LossyLink(1, CLEAN)
    link.send(b"a", 5)
    assert list(link.arrivals(1004)) == []
    assert link.next_arrival_ns == 1005
    assert list(link.arrivals(1005)) == [b"a"]
    assert link.next_arrival_ns is None
    assert carried(CLEAN)[0] == DATAGRAMS


def test_the_seed_decides_what_is_harmed() -> None:
    rough = Faults(drop=0.1, burst=0.01, duplicate=0.1, reorder=0.1, jitter_ns=5000, corrupt=0.1)
    assert carried(rough)[0] == carried(rough)[0]
    assert carried(rough)[0] != carried(rough, seed=4)[0]


@pytest.mark.parametrize(
    ("fault", "name", "share"),
    [
        ("drop", "lost", 0.1),
        ("duplicate", "duplicate", 0.2),
        ("reorder", "reordered", 0.1),
        ("corrupt", "corrupted", 0.3),
    ],
)
def test_a_fault_strikes_as_often_as_it_says(fault: str, name: str, share: float) -> None:
    _, link = carried(replace(CLEAN, **{fault: share}))
    assert link.done[name] == pytest.approx(share * len(DATAGRAMS), rel=0.2)


def test_bursts_lose_datagrams_in_a_row() -> None:
    arrived, link = carried(replace(CLEAN, burst=0.005, burst_length=20))
    gone = [k for k, datagram in enumerate(DATAGRAMS) if datagram not in set(arrived)]
    assert len(gone) == link.done["lost"] > 0
    runs = sum(later != earlier + 1 for earlier, later in pairwise(gone)) + 1
    assert len(gone) >= 15 * runs


def test_reordering_loses_nothing_and_changes_the_order() -> None:
    arrived, _ = carried(replace(CLEAN, reorder=0.1, reorder_ns=25_000))
    assert arrived != DATAGRAMS
    assert sorted(arrived) == sorted(DATAGRAMS)


def test_corruption_always_changes_the_datagram() -> None:
    link = LossyLink(3, replace(CLEAN, corrupt=1.0))
    for k in range(2000):
        link.send(b"some datagram", k)
    arrived = list(link.arrivals(10**12))
    assert len(arrived) == 2000
    assert b"some datagram" not in arrived


@pytest.mark.parametrize("clock", [AgentClock(), AgentClock(-(10**15), 50.0), AgentClock(10**15, -50.0)])
def test_an_agents_clock_can_be_read_both_ways(clock: AgentClock) -> None:
    true_ns = 123_456_789_012
    assert 0 <= clock.true_time(clock.read(true_ns)) - true_ns <= 3
