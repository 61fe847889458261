"""Rules of a take's clock: between two readings it is interpolated, beyond them it grows doubtful."""

from dataclasses import replace

import pytest

from rig_calib.take_clock import ClockMap, clock_maps, common_clock
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import EncodedFrame
from rig_protocol.recording_format import UTC, ClockReading, ClockTie, DroppedFrames

SECOND_NS = 1_000_000_000
RIG = "rig:0123"


def reading(time_ns: int, offset_ns: int, uncertainty_ns: int = 300, clock: str = RIG) -> ClockReading:
    return ClockReading(time_ns, (ClockTie(clock, offset_ns, uncertainty_ns),))


def test_between_readings_the_offset_is_linear_and_as_doubtful_as_the_worse_of_them() -> None:
    told = [reading(20 * SECOND_NS, 9_000, 500), reading(10 * SECOND_NS, 5_000, 300)]
    one = clock_maps("agent/0", told)[RIG]
    assert one.offset_at(10 * SECOND_NS) == (5_000, 500)
    offset_ns, uncertainty_ns = one.offset_at(15 * SECOND_NS)
    assert offset_ns == 7_000
    assert 5_000 <= uncertainty_ns <= 5_100  # 1 ppm of five seconds


def test_beyond_the_readings_a_free_crystal_is_expected() -> None:
    one = clock_maps("agent/0", [reading(10 * SECOND_NS, 5_000), reading(11 * SECOND_NS, 5_000)])[RIG]
    for time_ns in (9 * SECOND_NS, 12 * SECOND_NS):
        offset_ns, uncertainty_ns = one.offset_at(time_ns)
        assert offset_ns == 5_000
        assert 100_000 <= uncertainty_ns <= 100_001


def test_frames_and_drops_move_with_their_uncertainty_and_arrival() -> None:
    one = ClockMap((500, SECOND_NS), (-100, -100), (3_000, 3_000))
    frame = EncodedFrame(4, 7, 500, uncertainty_ns=4_000, received_ns=900)
    assert one.frame(frame) == replace(frame, timestamp_ns=400, uncertainty_ns=5_000, received_ns=800)
    assert one.dropped(DroppedFrames(4, 2, 500, 700)) == DroppedFrames(4, 2, 400, 600)
    assert one.frame(replace(frame, received_ns=None)).received_ns is None


def test_a_clock_that_cannot_be_is_refused_in_words() -> None:
    one = clock_maps("agent/0", [reading(0, 2**63 - 1, 2**63 - 1)])[RIG]
    with pytest.raises(DataError, match="out of reason"):
        one.frame(EncodedFrame(0, 0, 5))


def test_the_takes_own_clock_is_exact() -> None:
    assert clock_maps(RIG, [reading(0, 77, clock=UTC)])[RIG].offset_at(123) == (0, 0)


def test_the_clock_is_taken_on_which_the_worst_known_take_is_known_best() -> None:
    both = [ClockReading(0, (ClockTie(RIG, 1, 50_000), ClockTie(UTC, 1, 80_000)))]
    assert common_clock({"a": clock_maps("agent/0", both), "b": clock_maps("agent/1", both)}) == RIG
    worse = [ClockReading(0, (ClockTie(RIG, 1, 500_000), ClockTie(UTC, 1, 9_000)))]
    assert common_clock({"a": clock_maps("agent/0", both), "b": clock_maps("agent/1", worse)}) == UTC


def test_takes_that_share_no_clock_are_refused_with_what_each_knows() -> None:
    takes = {
        "a.mcap": clock_maps("agent/0", [reading(0, 1)]),
        "b.mcap": clock_maps("agent/1", [reading(0, 1, clock="rig:after-a-reboot")]),
        "c.mcap": clock_maps("agent/2", []),
    }
    told = "a.mcap knows rig:0123; b.mcap knows rig:after-a-reboot; c.mcap knows no other clock"
    with pytest.raises(ConfigurationError, match=told):
        common_clock(takes)
