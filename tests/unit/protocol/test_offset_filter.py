"""The line through the samples of a clock exchange."""

import pytest

from rig_protocol.offset_filter import MAX_SAMPLES, OffsetFilter, OffsetLine

INTERVAL_NS = 250_000_000
DAY_NS = 86_400 * 10**9


def fed(samples: int, drift: float, first_ns: int = 0) -> tuple[OffsetFilter, OffsetLine]:
    """A filter that saw so many samples of a perfect path, and its line."""
    offsets = OffsetFilter()
    for k in range(samples):
        line = offsets.add(first_ns + k * INTERVAL_NS, 10**15 + round(drift * k * INTERVAL_NS), 200_000)
    return offsets, line


def test_one_sample_is_a_line_that_is_doubted_by_what_crystals_may_drift() -> None:
    _, line = fed(1, 0)
    offset_ns, uncertainty_ns = line.at(10**9)
    assert offset_ns == 10**15
    assert 100_000 < uncertainty_ns < 200_000  # 100 ppm of a second, and the delay


def test_offset_and_drift_of_a_perfect_path_are_found() -> None:
    _, line = fed(MAX_SAMPLES, 50e-6)
    assert line.drift == pytest.approx(50e-6, abs=0.2e-6)
    ahead_ns = line.agent_ns + 10**9
    assert line.at(ahead_ns)[0] == pytest.approx(10**15 + 50e-6 * ahead_ns, abs=1_000)


def test_the_window_is_bounded_and_forgets() -> None:
    offsets, _ = fed(MAX_SAMPLES, 0)
    for k in range(MAX_SAMPLES, 2 * MAX_SAMPLES):
        line = offsets.add(k * INTERVAL_NS, 5 * 10**14, 200_000)
    assert len(offsets) == MAX_SAMPLES
    assert line.at(line.agent_ns)[0] == pytest.approx(5 * 10**14, abs=1)


def test_after_clearing_nothing_old_counts() -> None:
    offsets, _ = fed(MAX_SAMPLES, 50e-6)
    offsets.clear()
    line = offsets.add(7, 9, 200_000)
    assert (line.at(7)[0], len(offsets), line.drift) == (9, 1, 0)


def test_a_session_of_months_loses_no_precision() -> None:
    offsets, _ = fed(1, 0)
    for k in range(MAX_SAMPLES):
        line = offsets.add(200 * DAY_NS + k * INTERVAL_NS, 10**15 + 777, 200_000)
    assert line.at(line.agent_ns)[0] == pytest.approx(10**15 + 777, abs=10)
