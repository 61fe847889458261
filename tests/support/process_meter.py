"""What this process costs: processor time by thread, memory, page faults."""

import os
import resource
import threading
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class Reading:
    """The process at one moment, since its start."""

    wall_s: float
    cpu_s: float
    system_s: float
    minor_faults: int
    waits: int
    """Times that a thread gave up its core to wait for something."""
    thread_cpu_s: dict[str, float]
    """By name without its number; `others` are those that Python did not start."""


@dataclass(frozen=True)
class Cost:
    """What happened between two readings, a second of wall time."""

    cores: float
    system_cores: float
    minor_faults: float
    waits: float
    thread_cores: dict[str, float]


def read() -> Reading:
    """Now."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return Reading(
        wall_s=time.monotonic(),
        cpu_s=time.process_time(),
        system_s=usage.ru_stime,
        minor_faults=usage.ru_minflt,
        waits=usage.ru_nvcsw,
        thread_cpu_s=_thread_cpu_s(),
    )


def cost(before: Reading, after: Reading) -> Cost:
    """The difference, a second."""
    wall_s = after.wall_s - before.wall_s
    threads = {
        name: (cpu_s - before.thread_cpu_s.get(name, 0.0)) / wall_s
        for name, cpu_s in after.thread_cpu_s.items()
    }
    return Cost(
        cores=(after.cpu_s - before.cpu_s) / wall_s,
        system_cores=(after.system_s - before.system_s) / wall_s,
        minor_faults=(after.minor_faults - before.minor_faults) / wall_s,
        waits=(after.waits - before.waits) / wall_s,
        thread_cores={name: cores for name, cores in threads.items() if cores >= 0.001},
    )


def resident_mb() -> float:
    """Resident memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * _PAGE_BYTES / 1e6


def growth_mb(samples: list[tuple[float, float]]) -> float:
    """What memory grew by over samples of (seconds, MB): the slope of the least-squares line, times its length."""
    seconds, mb = np.array(samples).T
    return float(np.polyfit(seconds, mb, 1)[0] * (seconds[-1] - seconds[0]))


def _thread_cpu_s() -> dict[str, float]:
    names = {thread.native_id: thread.name.rsplit("-", 1)[0] for thread in threading.enumerate()}
    times: Counter[str] = Counter()
    for task in Path("/proc/self/task").iterdir():
        try:
            nanoseconds = int((task / "schedstat").read_text().split()[0])
        except OSError:  # the thread has just ended
            continue
        times[names.get(int(task.name), "others")] += nanoseconds
    return {name: nanoseconds / 1e9 for name, nanoseconds in times.items()}
