"""The wall clock's own quality, as the kernel and its daemon state it."""

import math
import time
from pathlib import Path

import pytest

from rig_protocol import system_clock
from rig_protocol.system_clock import KernelClock, SystemClock, boot_clock_name, kernel_clock

SECOND_NS = 1_000_000_000
WALL_MINUS_MONOTONIC_NS = 1_700_000_000 * SECOND_NS
NOT_STATED_US = 16_000_000


class Machine:
    """A kernel whose monotonic and wall clock tick together, and a daemon that states errors."""

    def __init__(self, max_error_us: int = 300, estimated_error_us: int = 20) -> None:
        self.now_ns = 10 * SECOND_NS
        self.delays_ns = [0]  # between two reads of a clock, in turn
        self.synchronised = True
        self.stated_us, self.stated_ns = max_error_us, self.now_ns
        self.estimated_error_us = estimated_error_us
        self.clock = SystemClock(self.monotonic_ns, self.wall_ns, self.kernel)

    def monotonic_ns(self) -> int:
        self.delays_ns.append(delay_ns := self.delays_ns.pop(0))
        self.now_ns += delay_ns
        return self.now_ns

    def wall_ns(self) -> int:
        return self.monotonic_ns() + WALL_MINUS_MONOTONIC_NS

    def kernel(self) -> KernelClock:
        grown_us = 500 * ((self.now_ns - self.stated_ns) // SECOND_NS)
        return KernelClock(self.synchronised, self.stated_us + grown_us, self.estimated_error_us)

    def update(self, max_error_us: int) -> None:
        """What a daemon does when it has measured again."""
        self.stated_us, self.stated_ns = max_error_us, self.now_ns

    def errors_ns(self, seconds: float, update_s: float, max_error_us: int) -> list[int | None]:
        """Two readings a second, while the daemon updates as often as that."""
        errors, end_ns = [], self.now_ns + seconds * SECOND_NS
        while self.now_ns < end_ns:
            if self.now_ns - self.stated_ns >= update_s * SECOND_NS:
                self.update(max_error_us)
            errors.append(self.clock.read().error_ns)
            self.now_ns += SECOND_NS // 2
        return errors


def test_the_monotonic_clock_is_named_after_the_boot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    boot_id = tmp_path / "boot_id"
    monkeypatch.setattr(system_clock, "_BOOT_ID", boot_id)
    assert boot_clock_name() is None
    boot_id.write_text("4e6c8943-8d49-4b9b-a633-c2a18ad5a104\n")
    assert boot_clock_name() == "rig:4e6c89438d494b9b"


def test_the_clocks_are_read_at_one_instant_even_when_the_reader_is_interrupted() -> None:
    machine = Machine()
    machine.delays_ns = [0, 7_000_000, 0, 0, 100, 100, 0, 0, 9_000_000]
    reading = machine.clock.read()
    assert reading.wall_minus_monotonic_ns == pytest.approx(WALL_MINUS_MONOTONIC_NS, abs=100)


def test_an_unsynchronised_clock_has_no_error_but_a_difference() -> None:
    machine = Machine()
    machine.synchronised = False
    reading = machine.clock.read()
    assert reading.wall_minus_monotonic_ns == WALL_MINUS_MONOTONIC_NS
    assert reading.error_ns is None


def test_the_error_holds_the_deviation_and_the_bound_as_they_were_stated() -> None:
    (error_ns,) = Machine(max_error_us=300, estimated_error_us=50).errors_ns(0.5, 64, 300)
    assert error_ns == pytest.approx(math.hypot(50_000, 300_000 / math.sqrt(3)), rel=0.01)


def test_the_bound_counts_as_stated_at_the_last_update_not_as_the_kernel_lets_it_grow() -> None:
    errors = Machine(max_error_us=300).errors_ns(64, 64, 300)
    assert errors[-1] is not None
    assert errors[0] is not None
    assert errors[0] < errors[-1] < errors[0] + 64_000  # 1 ppm over 64 s; the kernel's bound grew by 32 ms


def test_a_first_reading_between_updates_is_the_grown_bound_until_the_next_update() -> None:
    machine = Machine(max_error_us=300)
    machine.now_ns += 40 * SECOND_NS
    errors = machine.errors_ns(30, 64, 300)
    assert errors[0] is not None
    assert errors[0] > 10_000_000
    assert errors[-1] is not None
    assert errors[-1] < 200_000


def test_a_daemon_that_states_a_larger_bound_is_believed() -> None:
    machine = Machine(max_error_us=300)
    machine.errors_ns(5, 64, 300)
    machine.update(20_000)
    (error_ns,) = machine.errors_ns(0.5, 64, 300)
    assert error_ns is not None
    assert error_ns > 10_000_000


@pytest.mark.parametrize("estimated_error_us", [0, NOT_STATED_US])
def test_a_daemon_that_states_zero_once_a_minute_measures_nothing(estimated_error_us: int) -> None:
    machine = Machine(0, estimated_error_us)
    assert set(machine.errors_ns(200, 64, 0)) == {None}


@pytest.mark.parametrize("estimated_error_us", [0, NOT_STATED_US])
def test_a_daemon_that_resets_the_bound_every_second_is_ptp(estimated_error_us: int) -> None:
    errors = Machine(0, estimated_error_us).errors_ns(20, 1, 0)
    assert errors[:5] == [None] * 5
    assert errors[-1] is not None
    assert 10_000 <= errors[-1] <= 100_000


def test_ptp_that_stops_is_no_longer_believed() -> None:
    machine = Machine(0, NOT_STATED_US)
    machine.errors_ns(20, 1, 0)
    assert machine.errors_ns(5, 100, 0)[-1] is None


def test_this_machines_kernel_answers() -> None:
    state = kernel_clock()
    assert state.max_error_us >= 0
    assert state.estimated_error_us >= 0
    reading = SystemClock(time.monotonic_ns, time.time_ns).read()
    expected_ns = time.time_ns() - time.monotonic_ns()
    assert reading.wall_minus_monotonic_ns == pytest.approx(expected_ns, abs=50_000_000)
    assert state.synchronised or reading.error_ns is None
