"""Timestamps of OpenNI2: which unit they are in, and when recorded frames are due."""

from itertools import pairwise

import pytest

from rig_agent.sources.device_clock import TICK_HZ
from rig_agent.sources.openni_time import PlaybackClock, TimestampUnit

INTERVAL_US = 33_333
COUNTER = 1 << 32


def test_the_first_step_of_a_stream_tells_microseconds() -> None:
    unit = TimestampUnit(fps=30)
    assert unit.ticks("depth", 1_000, 1) is None
    assert unit.ticks("video", 9_000, 1) is None, "another stream's image is no step"
    assert not unit.is_known
    assert unit.ticks("depth", 1_000 + INTERVAL_US, 2) == (1_000 + INTERVAL_US) * 60
    assert unit.name == "microseconds"


def test_the_first_step_of_a_stream_tells_ticks_even_across_the_counters_wrap() -> None:
    unit = TimestampUnit(fps=30)
    assert unit.ticks("depth", COUNTER - 5, 1) is None
    assert unit.ticks("depth", 2_000_000 - 5, 2) == 2_000_000 - 5
    assert unit.name == "60-MHz ticks"


@pytest.mark.parametrize("units_per_us", [1, 60])
def test_frames_that_nobody_fetched_do_not_mislead(units_per_us: int) -> None:
    unit = TimestampUnit(fps=30)
    unit.ticks("depth", 0, 1)
    ticks = unit.ticks("depth", 60 * INTERVAL_US * units_per_us, 61)
    assert ticks == 60 * INTERVAL_US * 60


@pytest.mark.parametrize("step_us", [0, 10 * INTERVAL_US, -5 * INTERVAL_US])
def test_steps_that_fit_no_unit_are_microseconds_as_documented(step_us: int) -> None:
    unit = TimestampUnit(fps=30)
    stamps = [10_000_000 + i * step_us for i in range(12)]
    ticks = [unit.ticks("depth", stamp, i) for i, stamp in enumerate(stamps)]
    assert ticks[0] is None
    assert ticks[-1] == stamps[-1] * 60 % COUNTER


def test_a_recorded_frame_is_due_as_long_after_the_last_as_it_was_taken() -> None:
    clock = PlaybackClock(fps=30, clock=lambda: 5_000)
    stamps_us = [0, 33_000, 70_000, 400_000]
    due_ns = [clock.due_ns(stamp * 60 + COUNTER - 1) for stamp in stamps_us]
    assert due_ns == [5_000 + stamp * 1_000 for stamp in stamps_us]


@pytest.mark.parametrize("stamp", [0, 100 * TICK_HZ, 3 * TICK_HZ])
def test_a_cut_or_the_start_anew_takes_one_frame_interval(stamp: int) -> None:
    clock = PlaybackClock(fps=25, clock=lambda: 0)
    assert clock.due_ns(TICK_HZ) == 0
    assert clock.due_ns(stamp) == 40_000_000


def test_a_reader_that_was_away_goes_on_from_now() -> None:
    now_ns = 0
    clock = PlaybackClock(fps=30, clock=lambda: now_ns)
    clock.due_ns(0)
    now_ns = 10_000_000_000
    due_ns = [clock.due_ns(i * TICK_HZ // 30) for i in range(1, 4)]
    assert due_ns[0] == now_ns
    assert [later - earlier for earlier, later in pairwise(due_ns)] == [33_333_333] * 2
