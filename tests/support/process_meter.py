"""What this process costs: processor time by thread, memory, page faults."""

import os
import resource
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

_TICKS_A_SECOND = os.sysconf("SC_CLK_TCK")
_CALM_S = 2.0
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class Reading:
    """The process at one moment, since its start."""

    wall_s: float
    cpu_s: float
    system_s: float
    machine_s: float
    """Of all processes together."""
    minor_faults: int
    waits: int
    """Times that a thread gave up its core to wait for something."""
    thread_cpu_s: dict[str, float]
    """By name without its number; `others` are those that Python did not start."""
    thread_held_up_s: dict[str, float]
    """Ready to run, without a core: what a busy machine costs."""


@dataclass(frozen=True)
class Cost:
    """What happened between two readings, a second of wall time."""

    cores: float
    system_cores: float
    machine_cores: float
    minor_faults: float
    waits: float
    thread_cores: dict[str, float]
    thread_held_up: dict[str, float]


def read() -> Reading:
    """Now."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    running_s, held_up_s = _thread_times_s()
    return Reading(
        wall_s=time.monotonic(),
        cpu_s=time.process_time(),
        system_s=usage.ru_stime,
        machine_s=_machine_s(),
        minor_faults=usage.ru_minflt,
        waits=usage.ru_nvcsw,
        thread_cpu_s=running_s,
        thread_held_up_s=held_up_s,
    )


def cost(before: Reading, after: Reading) -> Cost:
    """The difference, a second."""
    wall_s = after.wall_s - before.wall_s
    return Cost(
        cores=(after.cpu_s - before.cpu_s) / wall_s,
        system_cores=(after.system_s - before.system_s) / wall_s,
        machine_cores=(after.machine_s - before.machine_s) / wall_s,
        minor_faults=(after.minor_faults - before.minor_faults) / wall_s,
        waits=(after.waits - before.waits) / wall_s,
        thread_cores=_rates(before.thread_cpu_s, after.thread_cpu_s, wall_s),
        thread_held_up=_rates(before.thread_held_up_s, after.thread_held_up_s, wall_s),
    )


def resident_mb() -> float:
    """Resident memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * _PAGE_BYTES / 1e6


def growth_mb(samples: Sequence[tuple[float, float]]) -> float:
    """Of samples of (seconds, MB): the median of the last third minus that of the first."""
    mb = [value for _, value in samples]
    third = max(1, len(mb) // 3)
    return median(mb[-third:]) - median(mb[:third])


def wait_for_calm(busy_cores: float, patience_s: float) -> None:
    """Return when the machine has been less busy than this for a while, or when patience ends."""
    until_s = time.monotonic() + patience_s
    while time.monotonic() < until_s:
        before_s = _machine_s()
        time.sleep(_CALM_S)
        if _machine_s() - before_s < busy_cores * _CALM_S:
            return


def _machine_s() -> float:
    """Seconds that any core was busy; what the host of a virtual machine took is in it."""
    ticks = [int(word) for word in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
    idle, waiting = ticks[3:5]
    return (sum(ticks) - idle - waiting) / _TICKS_A_SECOND


def _rates(before: dict[str, float], after: dict[str, float], wall_s: float) -> dict[str, float]:
    rates = {name: (seconds - before.get(name, 0.0)) / wall_s for name, seconds in after.items()}
    return {name: rate for name, rate in rates.items() if rate >= 0.001}


def _thread_times_s() -> tuple[dict[str, float], dict[str, float]]:
    """Seconds that threads ran, and that they waited for a core."""
    names = {thread.native_id: thread.name.rsplit("-", 1)[0] for thread in threading.enumerate()}
    running: Counter[str] = Counter()
    held_up: Counter[str] = Counter()
    for task in Path("/proc/self/task").iterdir():
        try:
            running_ns, held_up_ns, _ = map(int, (task / "schedstat").read_text().split())
        except OSError:  # the thread has just ended
            continue
        name = names.get(int(task.name), "others")
        running[name] += running_ns
        held_up[name] += held_up_ns
    return ({k: ns / 1e9 for k, ns in running.items()}, {k: ns / 1e9 for k, ns in held_up.items()})
