"""Counts are exact, quantiles right to a bucket's width, from any thread."""

import math
import threading
from bisect import bisect_left

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig_server.histogram import Histogram

durations = st.lists(st.integers(0, 1000), min_size=1, max_size=200)
ascending = st.lists(st.integers(1, 900), min_size=1, max_size=20, unique=True).map(sorted)


def filled(bounds: list[int], values: list[int]) -> Histogram:
    made = Histogram(bounds)
    for value in values:
        made.observe(value)
    return made


@given(ascending, durations)
def test_every_duration_is_counted_in_the_bucket_whose_bound_it_does_not_exceed(
    bounds: list[int], values: list[int]
) -> None:
    seen = filled(bounds, values).snapshot()
    for index, bound in enumerate([*bounds, math.inf]):
        assert sum(seen.counts[: index + 1]) == sum(value <= bound for value in values)
    assert (seen.count, seen.sum_ns) == (len(values), sum(values))


@given(ascending, durations, st.integers(1, 64))
def test_a_quantile_lies_in_the_same_bucket_as_numpys(
    bounds: list[int], values: list[int], part: int
) -> None:
    share = part / 64
    estimate = filled(bounds, values).snapshot().quantile_ns(share)
    exact = np.quantile(values, share, method="inverted_cdf")
    assert estimate is not None
    index = bisect_left(bounds, int(exact))
    if index == len(bounds):
        assert estimate == bounds[-1]
    else:
        assert (bounds[index - 1] if index else 0) <= estimate <= bounds[index]


def test_within_a_bucket_quantiles_are_interpolated() -> None:
    seen = filled([100, 200], [150] * 4).snapshot()
    assert [seen.quantile_ns(share) for share in (0.25, 0.5, 1.0)] == [125.0, 150.0, 200.0]


def test_a_histogram_of_nothing_has_no_quantile() -> None:
    assert Histogram([1]).snapshot().quantile_ns(0.5) is None


def test_what_lies_within_the_clocks_uncertainty_before_zero_counts_as_zero() -> None:
    seen = filled([10], [-5]).snapshot()
    assert (seen.counts, seen.sum_ns) == ((1, 0), 0)


def test_a_later_snapshot_minus_an_earlier_one_is_what_came_between() -> None:
    histogram = filled([10, 20], [5, 15])
    before = histogram.snapshot()
    histogram.observe(18)
    histogram.observe(50)
    between = histogram.snapshot().since(before)
    assert (between.counts, between.sum_ns) == ((0, 1, 1), 68)


def test_no_observation_of_several_threads_is_lost() -> None:
    histogram = Histogram([10, 20])
    start = threading.Barrier(4)

    def observe() -> None:
        start.wait()
        for value in range(5000):
            histogram.observe(value % 30)

    threads = [threading.Thread(target=observe) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert histogram.snapshot().count == 20_000


@pytest.mark.parametrize("bounds", [[], [0, 1], [2, 2], [3, 1]])
def test_bounds_that_are_no_buckets_are_refused(bounds: list[int]) -> None:
    with pytest.raises(ValueError, match="not positive and ascending"):
        Histogram(bounds)
