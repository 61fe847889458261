"""The measured period of a camera."""

import numpy as np
import pytest

from rig_protocol.frame_rate import FrameRate, period_of

PERIOD_NS = 33_333_333


def fed(rate: FrameRate, times_ns: list[int]) -> FrameRate:
    for time_ns in times_ns:
        rate.observe(time_ns)
    return rate


def test_until_frames_come_a_camera_runs_as_it_says_and_nonsense_counts_as_30_hz() -> None:
    assert FrameRate(15.0).period_ns == 66_666_667
    assert period_of(0.0) == period_of(1e9) == period_of(float("nan")) == PERIOD_NS


def test_jitter_is_averaged_out() -> None:
    rng = np.random.default_rng(1)
    times = 40_000_000 * np.arange(40) + rng.integers(-1_000_000, 1_000_000, 40)
    assert fed(FrameRate(30.0), times.tolist()).period_ns == pytest.approx(40_000_000, abs=250_000)


def test_with_four_of_ten_frames_lost_the_period_is_still_known() -> None:
    rng = np.random.default_rng(2)
    kept = np.flatnonzero(rng.random(300) < 0.6)
    assert fed(FrameRate(30.0), (PERIOD_NS * kept).tolist()).period_ns == PERIOD_NS


def test_a_change_of_rate_is_followed_within_seven_intervals() -> None:
    rate = fed(FrameRate(30.0), [PERIOD_NS * k for k in range(20)])
    fed(rate, [PERIOD_NS * 20 + 2 * PERIOD_NS * k for k in range(8)])
    assert rate.period_ns == 2 * PERIOD_NS


def test_frames_out_of_order_tell_nothing() -> None:
    rate = fed(FrameRate(30.0), [PERIOD_NS * k for k in (0, 1, 2, 3, 2, 1, 4, 3, 5, 5)])
    assert rate.period_ns == PERIOD_NS


def test_a_clock_that_was_set_back_starts_the_measurement_anew() -> None:
    rate = fed(FrameRate(30.0), [10**13 + PERIOD_NS * k for k in range(20)])
    fed(rate, [2 * PERIOD_NS * k for k in range(10)])
    assert rate.period_ns == 2 * PERIOD_NS


def test_no_stamps_make_a_camera_faster_or_slower_than_a_hello_may_say() -> None:
    assert fed(FrameRate(30.0), list(range(20))).period_ns == period_of(240.0)
    assert fed(FrameRate(30.0), [3600 * 10**9 * k for k in range(20)]).period_ns == period_of(0.1)
