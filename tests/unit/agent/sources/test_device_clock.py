"""Device ticks to agent time."""

import numpy as np
import pytest

from rig_agent.sources.device_clock import TICK_HZ, DeviceClock, tick_difference

FRAME_TICKS = TICK_HZ // 30
FRAME_NS = 1e9 / 30


def stamps_of(delays_ns: list[int], first_tick: int = 0, drift: float = 0.0) -> list[tuple[int, int, int]]:
    """(true ns, stamped ns, uncertainty ns) of frames that arrive with these delays."""
    clock, results = DeviceClock(), []
    for i, delay_ns in enumerate(delays_ns):
        true_ns = round(i * FRAME_NS)
        ticks = (first_tick + round(true_ns * (1 + drift) * TICK_HZ / 1e9)) % 2**32
        results.append((true_ns, *clock.stamp(ticks, true_ns + delay_ns)))
    return results


def test_the_difference_of_ticks_is_signed_and_crosses_the_wrap() -> None:
    assert tick_difference(5, 2**32 - 5) == 10
    assert tick_difference(2**32 - 5, 5) == -10
    assert tick_difference(7, 7) == 0


def test_the_first_frame_is_stamped_with_its_arrival() -> None:
    assert DeviceClock().stamp(123_456, 9_000_000_000)[0] == 9_000_000_000


def test_late_arrivals_do_not_move_the_stamps() -> None:
    results = stamps_of([0, *[300_000_000] * 50])
    assert [stamp for _, stamp, _ in results] == pytest.approx([true for true, _, _ in results], abs=20)


def test_stamps_stay_within_a_few_times_their_uncertainty_of_the_truth() -> None:
    delays = np.random.default_rng(1).uniform(0, 2e6, 600).astype(int)
    for true_ns, stamp_ns, uncertainty_ns in stamps_of(delays.tolist(), drift=50e-6)[5:]:
        assert abs(stamp_ns - true_ns) < 4 * uncertainty_ns
        assert uncertainty_ns < 1_000_000


def test_a_busy_machine_states_more_uncertainty() -> None:
    quiet, busy = (np.random.default_rng(1).uniform(0, limit, 90).astype(int) for limit in (2e6, 100e6))
    assert stamps_of(busy.tolist())[-1][2] > 3 * stamps_of(quiet.tolist())[-1][2]


def test_time_goes_on_across_the_wrap_of_the_counter() -> None:
    results = stamps_of([0] * 60, first_tick=2**32 - 30 * FRAME_TICKS)
    assert [stamp for _, stamp, _ in results] == pytest.approx([true for true, _, _ in results], abs=20)


@pytest.mark.parametrize("silence_s", [10, 71, 72, 100, 1000])
def test_a_silence_of_any_length_is_bridged(silence_s: int) -> None:
    clock = DeviceClock()
    clock.stamp(1000, 0)
    silence_ns = silence_s * 1_000_000_000
    stamp_ns, _ = clock.stamp((1000 + silence_s * TICK_HZ) % 2**32, silence_ns)
    assert stamp_ns == silence_ns
