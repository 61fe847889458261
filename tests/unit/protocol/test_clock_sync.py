import random
from collections.abc import Callable
from itertools import pairwise

import pytest

from rig_protocol.clock_sync import (
    FAST_INTERVAL_NS,
    FAST_REQUESTS,
    MAX_SAMPLES,
    REQUEST_INTERVAL_NS,
    ClockSync,
)
from rig_protocol.messages import ClockReply
from rig_protocol.testing import AgentClock

START_NS = 10**12
MS = 1_000_000
Delay = Callable[[], int]


class Exchange:
    """A clock being estimated over a path with a delay each way; 100 µs pass in the agent."""

    def __init__(self, clock: AgentClock, forth: Delay, back: Delay) -> None:
        self.clock, self.forth, self.back = clock, forth, back
        self.sync = ClockSync(START_NS)
        self.now_ns = START_NS

    def run(self, seconds: float, each: Callable[[], None] = lambda: None) -> "Exchange":
        """Exchange clocks for so long; `each` is called after every reply."""
        end_ns = self.now_ns + round(seconds * 1e9)
        while self.sync.next_request_ns <= end_ns:
            self.now_ns = max(self.now_ns, self.sync.next_request_ns)
            request = self.sync.request(self.now_ns)
            at_agent_ns = self.now_ns + self.forth()
            replied_ns = at_agent_ns + 100_000
            reply = ClockReply(request.t1_ns, self.clock.read(at_agent_ns), self.clock.read(replied_ns))
            assert self.sync.receive(reply, replied_ns + self.back())
            each()
        self.now_ns = end_ns
        return self

    def error(self, ahead_ns: int = 0) -> tuple[int, int]:
        """Error and stated uncertainty (ns) of a stamp of now."""
        mapped = self.sync.to_rig(self.clock.read(self.now_ns + ahead_ns))
        assert mapped is not None
        return mapped[0] - self.now_ns - ahead_ns, mapped[1]


def constant(delay_ns: int) -> Delay:
    return lambda: delay_ns


def jittery(seed: int, mean_ns: int, least_ns: int = 150_000) -> Delay:
    generator = random.Random(seed)
    return lambda: least_ns + round(generator.expovariate(1 / mean_ns))


def test_no_time_is_known_before_the_first_exchange() -> None:
    sync = ClockSync(START_NS)
    assert sync.to_rig(5) is None
    assert sync.estimate is None


def test_one_exchange_gives_the_offset_within_half_the_delay() -> None:
    clock = AgentClock(offset_ns=-(10**15))
    exchange = Exchange(clock, constant(300_000), constant(100_000)).run(0.0)
    error_ns, uncertainty_ns = exchange.error()
    assert error_ns == -100_000  # half the difference of the two ways
    assert abs(error_ns) <= 2 * uncertainty_ns
    estimate = exchange.sync.estimate
    assert estimate is not None
    assert (estimate.samples, estimate.delay_ns) == (1, 400_000)
    assert estimate.offset_ns == pytest.approx(10**15, abs=200_000)


def test_requests_come_fast_at_first_then_every_quarter_second() -> None:
    sync, times = ClockSync(START_NS), []
    for _ in range(FAST_REQUESTS + 2):
        times.append(sync.next_request_ns)
        sync.request(times[-1])
    gaps = [later - earlier for earlier, later in pairwise(times)]
    assert gaps == [FAST_INTERVAL_NS] * (FAST_REQUESTS - 1) + [REQUEST_INTERVAL_NS] * 2


@pytest.mark.parametrize("drift_ppm", [-50.0, 50.0])
@pytest.mark.parametrize("seed", range(3))
def test_under_50_ppm_drift_and_1_ms_jitter_the_error_stays_below_half_a_millisecond(
    drift_ppm: float, seed: int
) -> None:
    clock = AgentClock(offset_ns=-(3 * 10**14), drift_ppm=drift_ppm)
    exchange = Exchange(clock, jittery(seed, MS), jittery(seed + 100, MS)).run(5.0)
    errors: list[tuple[int, int]] = []
    exchange.run(60.0, lambda: errors.append(exchange.error()))
    magnitudes = sorted(abs(error_ns) for error_ns, _ in errors)
    assert magnitudes[int(0.99 * len(magnitudes))] < 0.5 * MS
    within = sum(abs(error_ns) <= 2 * uncertainty_ns for error_ns, uncertainty_ns in errors)
    assert within >= 0.95 * len(errors)
    estimate = exchange.sync.estimate
    assert estimate is not None
    assert estimate.drift_ppm == pytest.approx(-drift_ppm, abs=5.0)  # what the agent gains, the offset loses
    assert exchange.sync.steps == 0


def test_a_quiet_path_gives_microseconds() -> None:
    clock = AgentClock(drift_ppm=20.0)
    exchange = Exchange(clock, jittery(1, 20_000, 50_000), jittery(2, 20_000, 50_000)).run(30.0)
    error_ns, uncertainty_ns = exchange.error()
    assert abs(error_ns) < 20_000
    assert uncertainty_ns < 60_000


def test_the_uncertainty_grows_with_the_time_since_the_last_exchange() -> None:
    exchange = Exchange(AgentClock(drift_ppm=30.0), jittery(1, MS), jittery(2, MS)).run(10.0)
    doubts = [exchange.error(ahead_ns=seconds * 10**9)[1] for seconds in (0, 10, 100)]
    assert doubts == sorted(doubts)
    error_ns, uncertainty_ns = exchange.error(ahead_ns=100 * 10**9)
    assert abs(error_ns) <= 3 * uncertainty_ns


@pytest.mark.parametrize("step_ns", [-3_600 * 10**9, -5 * MS, 5 * MS, 3_600 * 10**9])
def test_a_step_is_noticed_at_the_next_exchange_and_fitted_anew(step_ns: int) -> None:
    exchange = Exchange(AgentClock(drift_ppm=10.0), jittery(1, 100_000), jittery(2, 100_000)).run(20.0)
    exchange.clock.offset_ns += step_ns
    exchange.run(REQUEST_INTERVAL_NS / 1e9)
    assert exchange.sync.steps == 1
    error_ns, uncertainty_ns = exchange.error()
    assert abs(error_ns) <= 4 * uncertainty_ns
    assert exchange.sync.next_request_ns - exchange.now_ns <= FAST_INTERVAL_NS


def test_heavy_jitter_is_no_step() -> None:
    exchange = Exchange(AgentClock(), jittery(1, 20 * MS), jittery(2, 20 * MS)).run(60.0)
    assert exchange.sync.steps == 0


def test_a_reply_answers_one_of_the_last_requests_once() -> None:
    sync = ClockSync(START_NS)
    first = sync.request(START_NS)
    good = ClockReply(first.t1_ns, 5, 6)
    assert not sync.receive(ClockReply(first.t1_ns + 1, 5, 6), START_NS + 10)
    assert sync.receive(good, START_NS + 10)
    assert not sync.receive(good, START_NS + 11)
    for k in range(1, 18):
        sync.request(START_NS + k)
    assert not sync.receive(ClockReply(START_NS + 1, 5, 6), START_NS + 30)


@pytest.mark.parametrize(("t2", "t3", "now"), [(6, 5, 10), (5, 100, 10), (0, 0, -1)])
def test_a_reply_with_impossible_times_is_refused(t2: int, t3: int, now: int) -> None:
    sync = ClockSync(START_NS)
    sync.request(START_NS)
    assert not sync.receive(ClockReply(START_NS, t2, t3), START_NS + now)


def test_extreme_times_are_arithmetic_not_a_crash() -> None:
    sync = ClockSync(START_NS)
    for k, extreme in enumerate((-(2**63), 2**63 - 1, 0, 2**62)):
        sync.request(START_NS + k)
        assert sync.receive(ClockReply(START_NS + k, extreme, extreme), START_NS + k + 10)
        assert sync.to_rig(2**63 - 1) is not None
        assert sync.to_rig(-(2**63)) is not None


def test_samples_are_bounded() -> None:
    exchange = Exchange(AgentClock(), constant(1000), constant(1000)).run(2 * MAX_SAMPLES / 4)
    estimate = exchange.sync.estimate
    assert estimate is not None
    assert estimate.samples == MAX_SAMPLES


def test_hurrying_brings_the_next_request_forward() -> None:
    sync = ClockSync(START_NS)
    for _ in range(FAST_REQUESTS):
        sync.request(sync.next_request_ns)
    before_ns = sync.next_request_ns
    sync.hurry()
    assert sync.next_request_ns == before_ns - REQUEST_INTERVAL_NS + FAST_INTERVAL_NS
