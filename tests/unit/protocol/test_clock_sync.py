import math
import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import pytest

from rig_protocol.clock_sync import (
    FAST_INTERVAL_NS,
    FAST_REQUESTS,
    REQUEST_INTERVAL_NS,
    SYSTEM_CLOCK_LIFE_NS,
    ClockSync,
)
from rig_protocol.messages import ClockReply
from rig_protocol.offset_filter import MAX_SAMPLES
from rig_protocol.system_clock import SystemClockReading
from rig_protocol.testing import AgentClock
from support.clock_simulation import ClockSimulation, FrameTime, WanderingClock, Way

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


def p99_ns(frames: Sequence[FrameTime]) -> float:
    """What 99 % of the frames' errors stay below."""
    return sorted(abs(frame.error_ns) for frame in frames)[int(0.99 * len(frames))]


def normalised_rms(frames: Sequence[FrameTime]) -> float:
    """Root mean square of error over stated uncertainty: 1 when it is the standard deviation."""
    return math.sqrt(sum((frame.error_ns / frame.uncertainty_ns) ** 2 for frame in frames) / len(frames))


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


SLOW, FAST = WanderingClock(drift_ppm=-50), WanderingClock(drift_ppm=50)
WARMING = WanderingClock(drift_ppm=20, swing_ppm=5, period_s=120)
QUIET = Way(jitter_ns=20_000, spikes=0, loss=0)


@pytest.mark.parametrize("clock", [SLOW, FAST, WARMING], ids=["-50 ppm", "+50 ppm", "20 ± 5 ppm"])
@pytest.mark.parametrize("seed", range(3))
def test_under_drift_1_ms_jitter_spikes_and_loss_frames_err_below_half_a_millisecond(
    clock: WanderingClock, seed: int
) -> None:
    simulation = ClockSimulation(replace(clock), seed=seed).run(0.3)
    first = simulation.run(4.7).frames[9:]
    later = simulation.run(85).frames[150:]
    for frames in (first, later):
        assert p99_ns(frames) < 0.5 * MS
        assert 0.1 < normalised_rms(frames) < 1.3
    assert simulation.sync.steps == 0


@pytest.mark.parametrize("jitter_ns", [0, 20_000, 1_000_000])
def test_the_stated_uncertainty_is_honest_however_the_least_delay_is_shared(jitter_ns: int) -> None:
    frames: list[FrameTime] = []
    for seed in range(20):
        least_ns = random.Random(seed).randrange(600_000)
        forth, back = (Way(least_ns, jitter_ns, spikes=0) for least_ns in (least_ns, 600_000 - least_ns))
        frames += ClockSimulation(replace(FAST), forth, back, seed).run(20).frames
    assert 0.4 < normalised_rms(frames) < 1.3


def test_queues_in_one_direction_only_are_within_the_stated_uncertainty() -> None:
    simulation = ClockSimulation(replace(FAST), Way(jitter_ns=2 * MS), Way(jitter_ns=50_000)).run(60)
    assert p99_ns(simulation.frames[150:]) < 0.5 * MS
    assert normalised_rms(simulation.frames) < 1.3


@pytest.mark.parametrize("seed", range(4))
def test_rig_time_never_jumps_needlessly_and_frames_keep_their_order(seed: int) -> None:
    frames = ClockSimulation(replace(WARMING), seed=seed).run(60).frames
    assert all(later.mapped_ns > earlier.mapped_ns for earlier, later in pairwise(frames))
    jumps = [abs(b.error_ns - a.error_ns) / a.uncertainty_ns for a, b in pairwise(frames)]
    assert max(jumps) < 2
    assert sum(jump > 0.25 for jump in jumps) < 0.01 * len(jumps)


@pytest.mark.parametrize("step_s", [-3600, -10, -0.1, -0.005, 0.005, 0.1, 10, 3600])
@pytest.mark.parametrize("way", [Way(), QUIET], ids=["jittery", "quiet"])
def test_300_ms_after_a_step_was_noticed_frames_err_below_half_a_millisecond(step_s: float, way: Way) -> None:
    frames: list[FrameTime] = []
    for seed in range(3):
        simulation = ClockSimulation(replace(FAST), way, way, seed).run(20 + 0.07 * seed)
        simulation.clock.offset_ns += round(step_s * 1e9)
        stepped_ns = simulation.now_ns
        while not simulation.sync.steps:
            simulation.run(0.01)
        # The next reply tells; the jittery path loses some, and delays some of them so long that they prove
        # little about a step of milliseconds.
        assert simulation.now_ns - stepped_ns <= (270 * MS if way == QUIET else 1_000 * MS)
        misdated = [frame for frame in simulation.frames if frame.true_ns > stepped_ns]
        assert all(abs(frame.error_ns) <= abs(step_s) * 1e9 + MS for frame in misdated)
        seen = len(simulation.frames)
        simulation.run(0.3)
        frames += simulation.run(5).frames[seen + 10 :]
        assert simulation.sync.steps == 1
    assert p99_ns(frames) < 0.5 * MS
    assert normalised_rms(frames) < 1.3


def test_a_step_of_less_than_the_jitter_is_noticed_by_the_best_samples() -> None:
    simulation = ClockSimulation(replace(SLOW)).run(30)
    simulation.clock.offset_ns += MS
    simulation.run(2)
    assert simulation.sync.steps == 1


def test_no_step_is_seen_where_none_was() -> None:
    for seed in range(40):
        assert ClockSimulation(replace(FAST), seed=seed).run(5).sync.steps == 0


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


class WallClocks:
    """Two machines whose wall clocks are disciplined: what each would say of its own."""

    def __init__(self, simulation: ClockSimulation, error_ns: int = 20_000) -> None:
        self.simulation, self.error_ns = simulation, error_ns

    def report(self, agent_wall_late_ns: int = 0) -> None:
        """Give the sync both readings; the agent's wall clock is wrong by so much."""
        now_ns = self.simulation.now_ns
        agent_ns = self.simulation.clock.read(now_ns)
        agent = SystemClockReading(10**18 - agent_ns - agent_wall_late_ns, self.error_ns)
        rig = SystemClockReading(10**18 - now_ns, self.error_ns)
        self.simulation.sync.use_system_clocks(agent, rig, now_ns)

    def error_ns_now(self) -> tuple[int, int]:
        """Error and stated uncertainty of a stamp of now."""
        mapped = self.simulation.sync.to_rig(self.simulation.clock.read(self.simulation.now_ns))
        assert mapped is not None
        return mapped[0] - self.simulation.now_ns, mapped[1]


def source_of(sync: ClockSync) -> str:
    assert sync.estimate is not None
    return sync.estimate.source


def test_disciplined_wall_clocks_are_used_where_they_are_better_than_the_exchange() -> None:
    simulation = ClockSimulation(WanderingClock(), Way(400_000), Way(100_000)).run(10)
    walls = WallClocks(simulation)
    walls.report(agent_wall_late_ns=15_000)
    assert source_of(simulation.sync) == "system"
    assert walls.error_ns_now() == (-15_000, math.ceil(20_000 * math.sqrt(2)))
    assert simulation.sync.system_clock_disagreements == 0


def test_wall_clocks_worse_than_the_exchange_are_not_used() -> None:
    simulation = ClockSimulation(WanderingClock(), QUIET, QUIET).run(10)
    WallClocks(simulation, error_ns=400_000).report()
    assert source_of(simulation.sync) == "exchange"
    assert simulation.sync.system_clock_disagreements == 0


@pytest.mark.parametrize("apart_ns", [-2 * MS, 2 * MS, 10**9])
def test_wall_clocks_that_follow_different_sources_are_caught_by_the_exchange(apart_ns: int) -> None:
    simulation = ClockSimulation(WanderingClock(), seed=7).run(10)
    walls = WallClocks(simulation)
    before = walls.error_ns_now()
    walls.report(agent_wall_late_ns=apart_ns)
    assert simulation.sync.system_clock_disagreements == 1
    assert source_of(simulation.sync) == "exchange"
    assert walls.error_ns_now() == before


def test_wall_clocks_prove_nothing_before_the_first_exchange() -> None:
    sync = ClockSync(START_NS)
    sync.use_system_clocks(SystemClockReading(0, 1000), SystemClockReading(0, 1000), START_NS)
    assert sync.to_rig(5) is None


@pytest.mark.parametrize("reading", [None, SystemClockReading(0, None), SystemClockReading(0, -5)])
def test_a_wall_clock_of_unknown_quality_ends_the_use_of_both(reading: SystemClockReading | None) -> None:
    simulation = ClockSimulation(WanderingClock()).run(10)
    WallClocks(simulation).report()
    simulation.sync.use_system_clocks(reading, SystemClockReading(0, 1000), simulation.now_ns)
    assert source_of(simulation.sync) == "exchange"
    assert simulation.sync.system_clock_disagreements == 0


def test_readings_of_wall_clocks_expire() -> None:
    simulation = ClockSimulation(WanderingClock()).run(10)
    WallClocks(simulation).report()
    simulation.run(SYSTEM_CLOCK_LIFE_NS / 1e9 - 1)
    assert source_of(simulation.sync) == "system"
    simulation.run(3)
    assert source_of(simulation.sync) == "exchange"


def test_a_step_of_the_agents_clock_ends_the_use_of_wall_clocks_until_they_are_read_anew() -> None:
    simulation = ClockSimulation(WanderingClock(), QUIET, QUIET).run(10)
    walls = WallClocks(simulation)
    walls.report()
    simulation.clock.offset_ns += 10**9
    simulation.run(0.5)
    assert source_of(simulation.sync) == "exchange"
    walls.report()
    assert source_of(simulation.sync) == "system"
    assert walls.error_ns_now()[0] == 0
