"""Unplugging and plugging in a Kinect again and again: does the agent's process stay as small as it was?

Run: python tests/benchmarks/kinect_replug.py [--cycles 1000]
"""

import argparse
import ctypes
import gc
import logging
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rig_agent.sources.base import SourceLost
from rig_agent.sources.freenect import FreenectSettings, FreenectSource
from rig_protocol.codecs import keep_freed_memory
from support import process_meter
from support.virtual_usb.virtual_bus import VirtualBus, VirtualKinect, enter

CYCLES, WARM_UP = 1000, 50
_SAMPLES = 10
_NOTICE_LIMIT_S = 3.0
_MAX_LEAK_KB = 0.3  # a cycle: a Kinect that is pulled every minute costs less than 0.5 MB a day


class Holdings(NamedTuple):
    """What a process holds; `allocated_mb` is what was asked of malloc and not given back."""

    resident_mb: float
    allocated_mb: float
    threads: int
    descriptors: int
    usb_handles: int


def holdings(kinect: VirtualKinect) -> Holdings:
    """Of this process, now."""
    gc.collect()
    descriptors = len(list(Path("/proc/self/fd").iterdir()))
    return Holdings(
        round(process_meter.resident_mb(), 1),
        round(allocated_mb(), 3),
        threading.active_count(),
        descriptors,
        kinect.open_handles(),
    )


class _MallocInfo(ctypes.Structure):
    """`struct mallinfo2` of glibc 2.33."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in (
            "arena",
            "ordblks",
            "smblks",
            "hblks",
            "hblkhd",
            "usmblks",
            "fsmblks",
            "uordblks",
            "fordblks",
            "keepcost",
        )
    )


def allocated_mb() -> float:
    """Of all arenas and mapped blocks."""
    mallinfo2 = ctypes.CDLL(None).mallinfo2
    mallinfo2.restype = _MallocInfo
    info = mallinfo2()
    return float(info.uordblks + info.hblkhd) / 1e6


def replug(kinect: VirtualKinect) -> float:
    """One cycle: stream, pull, notice, release, plug in; seconds from the pull to the notice."""
    kinect.plug()
    with FreenectSource(FreenectSettings()) as source:
        if source.read(3.0) is None:
            raise RuntimeError("no frame for 3 s")
        pulled_s = time.monotonic()
        kinect.unplug()
        try:
            while time.monotonic() - pulled_s < _NOTICE_LIMIT_S:
                source.read(0.1)
        except SourceLost:
            return time.monotonic() - pulled_s
    raise RuntimeError(f"an unplugged Kinect went unnoticed for {_NOTICE_LIMIT_S} s")


def replugs(kinect: VirtualKinect, cycles: int) -> Iterator[tuple[int, float, Holdings]]:
    """Cycle, slowest notice in seconds and holdings, at the end of each tenth."""
    slowest_s = 0.0
    for cycle in range(1, cycles + 1):
        slowest_s = max(slowest_s, replug(kinect))
        if cycle % max(1, cycles // _SAMPLES) == 0:
            yield cycle, slowest_s, holdings(kinect)


def report(cycles: int) -> bool:
    """Print what was held along the way; False when it grew."""
    logging.getLogger("rig_agent").setLevel(logging.CRITICAL)  # it has six lines to say about every cycle
    keep_freed_memory()  # as the agent does
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        bus = VirtualBus(Path(folder) / "usb")
        enter(bus, patch)
        kinect = bus.add_kinect("A00364A11111111A", plugged=False)
        for _ in range(WARM_UP):
            replug(kinect)
        first = last = holdings(kinect)
        print(f"after {WARM_UP} cycles to warm up: {first}")
        for cycle, slowest_s, last in replugs(kinect, cycles):
            print(f"{cycle} cycles, noticed within {1000 * slowest_s:.0f} ms: {last}", flush=True)
    grown_mb = last.allocated_mb - first.allocated_mb
    print(f"{cycles} replugs: {1e3 * grown_mb:+.0f} kB, ", end="")
    print(f"{last.threads - first.threads:+d} threads, {last.descriptors - first.descriptors:+d} descriptors")
    return last[2:] == first[2:] and 1e3 * grown_mb < _MAX_LEAK_KB * cycles


def main() -> None:
    """Exit status 1 when something leaks."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cycles", type=int, default=CYCLES)
    sys.exit(0 if report(parser.parse_args().cycles) else 1)


if __name__ == "__main__":
    main()
