"""Whatever an agent says of its clocks: rig time stays within what the exchange allows."""

from hypothesis import given, settings
from hypothesis import strategies as st

from rig_agent.sources.device_clock import DeviceClock
from rig_protocol.clock_sync import ClockSync
from rig_protocol.messages import ClockReply
from rig_protocol.system_clock import SystemClockReading
from support.wire import T0

examples = settings(deadline=None, derandomize=True, max_examples=150)
I64 = st.integers(-(2**63), 2**63 - 1)


@examples
@given(I64, I64, st.none() | I64, st.none() | I64, I64)
def test_no_reading_of_wall_clocks_moves_rig_time_beyond_what_the_exchange_allows(
    agent_wall_ns: int, rig_wall_ns: int, agent_error_ns: int | None, rig_error_ns: int | None, t2_ns: int
) -> None:
    sync = ClockSync(T0)
    sync.receive(ClockReply(sync.request(T0).t1_ns, t2_ns, t2_ns), T0 + 1_000_000)
    exchanged = sync.to_rig(t2_ns)
    sync.use_system_clocks(
        SystemClockReading(agent_wall_ns, agent_error_ns), SystemClockReading(rig_wall_ns, rig_error_ns), T0
    )
    mapped = sync.to_rig(t2_ns)
    assert exchanged is not None
    assert mapped is not None
    assert abs(mapped[0] - exchanged[0]) <= 2 * exchanged[1] + 500_000
    assert mapped[1] <= exchanged[1]


@examples
@given(st.lists(st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 10**13)), min_size=1, max_size=40))
def test_whatever_a_device_counts_stamps_rise_and_none_is_after_its_arrival(
    frames: list[tuple[int, int]],
) -> None:
    clock, arrival_ns, last_ns = DeviceClock(), 0, -1
    for ticks, later_ns in frames:
        arrival_ns += 1 + later_ns
        stamp_ns, uncertainty_ns = clock.stamp(ticks, arrival_ns)
        assert last_ns < stamp_ns <= arrival_ns
        assert uncertainty_ns > 0
        last_ns = stamp_ns
