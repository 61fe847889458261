"""Device ticks to agent time."""

from itertools import pairwise

import numpy as np
import pytest

from rig_agent.sources.device_clock import TICK_HZ, DeviceClock, tick_difference
from support.device_simulation import DeviceSimulation, FrameDelays, StampedFrame

FRAME_TICKS = TICK_HZ // 30
FRAME_NS = 1e9 / 30
MS = 1_000_000


def stamps_of(delays_ns: list[int], first_tick: int = 0, drift: float = 0.0) -> list[tuple[int, int, int]]:
    """(true ns, stamped ns, uncertainty ns) of frames that arrive with these delays."""
    clock, results = DeviceClock(), []
    for i, delay_ns in enumerate(delays_ns):
        true_ns = round(i * FRAME_NS)
        ticks = (first_tick + round(true_ns * (1 + drift) * TICK_HZ / 1e9)) % 2**32
        results.append((true_ns, *clock.stamp(ticks, true_ns + delay_ns)))
    return results


def errors_ns(frames: list[StampedFrame], least_ns: int = FrameDelays().least_ns) -> np.ndarray:
    """Errors of the stamps beside the delay that all frames have."""
    return np.array([frame.stamp_ns - frame.true_ns - least_ns for frame in frames])


def p99(values: np.ndarray) -> float:
    return float(np.percentile(np.abs(values), 99))


def rises(frames: list[StampedFrame]) -> bool:
    return all(later.stamp_ns > earlier.stamp_ns for earlier, later in pairwise(frames))


def test_the_difference_of_ticks_is_signed_and_crosses_the_wrap() -> None:
    assert tick_difference(5, 2**32 - 5) == 10
    assert tick_difference(2**32 - 5, 5) == -10
    assert tick_difference(7, 7) == 0


def test_the_first_frame_is_stamped_with_its_arrival() -> None:
    assert DeviceClock().stamp(123_456, 9_000_000_000)[0] == 9_000_000_000


def test_late_arrivals_do_not_move_the_stamps() -> None:
    results = stamps_of([0, *[50 * MS] * 50])
    assert [stamp for _, stamp, _ in results] == pytest.approx([true for true, _, _ in results], abs=20)


@pytest.mark.parametrize(
    ("drift_ppm", "swing_ppm"), [(100, 0), (-100, 0), (40, 3), (-40, 5)], ids=lambda value: f"{value}ppm"
)
@pytest.mark.parametrize("seed", range(2))
def test_after_four_seconds_stamps_carry_neither_transfer_nor_host_jitter(
    drift_ppm: float, swing_ppm: float, seed: int
) -> None:
    simulation = DeviceSimulation(drift_ppm, swing_ppm, period_s=150, seed=seed)
    simulation.run(4)
    frames = simulation.run(116)
    errors = errors_ns(frames)
    assert p99(errors) < 0.3 * MS
    assert p99(np.diff(errors)) < 0.05 * MS
    assert rises(frames)
    assert all(frame.stamp_ns <= frame.arrival_ns for frame in frames)
    uncertainties = np.array([frame.uncertainty_ns for frame in frames])
    assert 0.1 < np.sqrt(np.mean((errors / uncertainties) ** 2)) < 1.2


@pytest.mark.parametrize(
    # Where crystals agree so well that the beat outlasts the window, it is a delay that all frames have.
    ("beats", "most"),
    [(False, 1.3), (True, 2.0)],
    ids=["random transfers", "transfers that beat"],
)
def test_the_stated_uncertainty_is_honest_from_the_first_frame(beats: bool, most: float) -> None:
    normalised: list[np.ndarray] = []
    for seed in range(12):
        delays = FrameDelays(beats=beats)
        simulation = DeviceSimulation(drift_ppm=100 - 20 * seed, delays=delays, seed=seed)
        simulation.now_ns += seed * 1_234_567  # another phase of the bus' grid
        frames = simulation.run(30)
        uncertainties = np.array([frame.uncertainty_ns for frame in frames])
        normalised.append(errors_ns(frames) / uncertainties)
    for part in (slice(0, 30), slice(30, 150), slice(150, None)):
        rms = np.sqrt(np.mean([np.mean(run[part] ** 2) for run in normalised]))
        assert 0.1 < rms < most


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


@pytest.mark.parametrize("silence_s", [5, 50, 300, 4000])
def test_after_a_silence_of_many_wraps_stamps_are_within_the_stated_doubt(silence_s: float) -> None:
    simulation = DeviceSimulation(drift_ppm=80, seed=3)
    simulation.run(20)
    simulation.run(silence_s, silent=True)
    frames = simulation.run(10)
    for frame, error_ns in zip(frames, errors_ns(frames), strict=True):
        assert abs(error_ns) < 4 * frame.uncertainty_ns
    assert p99(errors_ns(frames[120:])) < 0.3 * MS
    assert rises(simulation.frames)


@pytest.mark.parametrize("reset_s", [-30.0, -1.0, -0.04, 0.5, 20.0, 35.0])
def test_a_counter_that_is_reset_to_anything_is_followed_within_three_frames(reset_s: float) -> None:
    simulation = DeviceSimulation(drift_ppm=-60, seed=4)
    simulation.run(20)
    simulation.first_tick += round(reset_s * TICK_HZ)
    frames = simulation.run(10)
    assert max(abs(errors_ns(frames[3:60]))) < 4 * MS  # the first frame's own delay
    assert p99(errors_ns(frames[150:])) < 0.3 * MS
    assert rises(simulation.frames)


@pytest.mark.parametrize("asleep_s", [0.2, 60.0, 71.6, 100.0, 300.0])
def test_a_host_that_slept_is_followed_within_three_frames(asleep_s: float) -> None:
    """Its monotonic clock stands still meanwhile, the device's does not."""
    simulation = DeviceSimulation(drift_ppm=30, seed=5)
    simulation.run(20)
    simulation.first_tick += round(asleep_s * TICK_HZ)
    frames = simulation.run(10)
    assert max(abs(errors_ns(frames[3:60]))) < 60 * MS
    assert p99(errors_ns(frames[150:])) < 0.3 * MS
    assert rises(simulation.frames)


def test_a_frame_that_the_host_left_lying_moves_no_other_and_says_its_doubt() -> None:
    clock = DeviceClock()
    stamps = [clock.stamp(i * FRAME_TICKS, round(i * FRAME_NS)) for i in range(300)]
    ticks, true_ns = 300 * FRAME_TICKS, round(300 * FRAME_NS)
    late_ns, doubt_ns = clock.stamp(ticks, true_ns + 3_000_000_000)
    assert late_ns == pytest.approx(true_ns, abs=20)
    assert doubt_ns >= 3_000_000_000  # it may as well have been a reset
    after_ns, doubt_ns = clock.stamp(390 * FRAME_TICKS + 60, round(390 * FRAME_NS) + 1000)
    assert after_ns == pytest.approx(390 * FRAME_NS, abs=2000)
    assert doubt_ns < 2 * stamps[-1][1]
