"""How well time is known: clock exchange and device ticks in simulation, the exchange over real loopback.

Run: python tests/benchmarks/bench_clock.py
"""

import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rig_agent.sources.device_clock import TICK_HZ, DeviceClock
from rig_protocol.clock_sync import ClockSync
from rig_protocol.messages import ClockReply, ClockRequest
from rig_protocol.system_clock import SystemClock
from support.benchmark_record import markdown_table
from support.clock_simulation import START_NS, ClockSimulation, WanderingClock, Way
from support.device_simulation import DeviceSimulation, FrameDelays

SEEDS = range(10)
LOOPBACK_S = 15.0
SETTLED_S = 5.0
LOOPBACK_SETTLED_S = 1.0
_QUIET = Way(jitter_ns=20_000, spikes=0, loss=0)
_ADDRESS = ("127.0.0.1", 0)

EXCHANGES: dict[str, tuple[WanderingClock, Way, Way, float]] = {
    "+50 ppm, 1 ms jitter": (WanderingClock(drift_ppm=50), Way(), Way(), 0),
    "-50 ppm, 1 ms jitter": (WanderingClock(drift_ppm=-50), Way(), Way(), 0),
    "20 ± 5 ppm in 2 min, 1 ms jitter": (WanderingClock(0, 20, 5, 120), Way(), Way(), 0),
    "queues one way only, 2 ms": (WanderingClock(drift_ppm=50), Way(jitter_ns=2_000_000), _QUIET, 0),
    "least delay 0.5 ms, 4 to 1": (WanderingClock(drift_ppm=50), Way(400_000), Way(100_000), 0),
    "quiet network": (WanderingClock(drift_ppm=50), _QUIET, _QUIET, 0),
    "step of 1 h, from 0.3 s after it was noticed": (WanderingClock(drift_ppm=50), Way(), Way(), 3600),
}
DEVICES: dict[str, DeviceSimulation] = {
    "+100 ppm": DeviceSimulation(100),
    "-100 ppm": DeviceSimulation(-100),
    "40 ± 5 ppm in 2 min": DeviceSimulation(40, 5, 120),
    "transfers that beat": DeviceSimulation(20, delays=FrameDelays(beats=True)),
}


def accuracy(errors_ns: Sequence[int], uncertainties_ns: Sequence[int]) -> dict[str, float]:
    """Quantiles of the error, the stated uncertainty, and the rms of one over the other."""
    errors, uncertainties = np.array(errors_ns), np.array(uncertainties_ns)
    return {
        "p50_us": float(np.percentile(abs(errors), 50)) / 1e3,
        "p99_us": float(np.percentile(abs(errors), 99)) / 1e3,
        "stated_us": float(np.median(uncertainties)) / 1e3,
        "normalised_rms": float(np.sqrt(np.mean((errors / uncertainties) ** 2))),
    }


def exchange(clock: WanderingClock, forth: Way, back: Way, step_s: float) -> dict[str, float]:
    """Frames of two minutes of the clock exchange, or of the first 5 s after a step."""
    frames = []
    for seed in SEEDS:
        copy = WanderingClock(clock.offset_ns, clock.drift_ppm, clock.swing_ppm, clock.period_s)
        simulation = ClockSimulation(copy, forth, back, seed).run(SETTLED_S)
        if step_s:
            copy.offset_ns += round(step_s * 1e9)
            while not simulation.sync.steps:
                simulation.run(0.01)
            simulation.run(0.3)
        since_ns = simulation.now_ns
        frames += [
            frame for frame in simulation.run(5 if step_s else 120).frames if frame.true_ns >= since_ns
        ]
    return accuracy([frame.error_ns for frame in frames], [frame.uncertainty_ns for frame in frames])


def device(settings: DeviceSimulation) -> dict[str, float]:
    """Stamps of two minutes of a device, beside the delay that all frames have; and their intervals."""
    errors: list[int] = []
    uncertainties: list[int] = []
    changes: list[NDArray[np.int64]] = []
    for seed in SEEDS:
        simulation = DeviceSimulation(
            settings.drift_ppm, settings.swing_ppm, settings.period_s, settings.delays, seed
        )
        simulation.run(SETTLED_S)
        frames = simulation.run(120)
        least_ns = settings.delays.least_ns
        run_errors = [frame.stamp_ns - frame.true_ns - least_ns for frame in frames]
        errors += run_errors
        uncertainties += [frame.uncertainty_ns for frame in frames]
        changes.append(abs(np.diff(np.array(run_errors))))
    interval_us = float(np.percentile(np.concatenate(changes), 99)) / 1e3
    return accuracy(errors, uncertainties) | {"interval_p99_us": interval_us}


class LoopbackAgent:
    """Answers clock requests on a thread; its clock has an offset and gains 40 ppm on this machine's."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(_ADDRESS)
        self.start_ns = time.monotonic_ns()
        self.thread = threading.Thread(target=self._answer, daemon=True)
        self.thread.start()

    def read(self, rig_ns: int) -> int:
        """Agent time at a time of this machine's monotonic clock."""
        return rig_ns - 10**15 + round((rig_ns - self.start_ns) * 40e-6)

    def _answer(self) -> None:
        while True:
            datagram, address = self.socket.recvfrom(64)
            received_ns = self.read(time.monotonic_ns())
            if not datagram:
                return
            sent_ns = self.read(time.monotonic_ns())
            answer = np.array([int.from_bytes(datagram, "little"), received_ns, sent_ns], np.int64)
            self.socket.sendto(answer.tobytes(), address)


def loopback(seconds: float = LOOPBACK_S) -> dict[str, float]:
    """A real exchange over UDP on this machine; after a second, dates of now, every 5 ms."""
    agent, sync = LoopbackAgent(), ClockSync(time.monotonic_ns())
    errors, uncertainties = [], []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(_ADDRESS)
        server.settimeout(0.005)
        start_ns = time.monotonic_ns()
        while (now_ns := time.monotonic_ns()) < start_ns + seconds * 1e9:
            if sync.next_request_ns <= now_ns:
                request = sync.request(time.monotonic_ns())
                server.sendto(request.t1_ns.to_bytes(8, "little"), agent.socket.getsockname())
            try:
                t1_ns, t2_ns, t3_ns = np.frombuffer(server.recv(64), np.int64).tolist()
                sync.receive(ClockReply(t1_ns, t2_ns, t3_ns), time.monotonic_ns())
            except TimeoutError:
                pass
            mapped = sync.to_rig(agent.read(now_ns))
            if mapped is not None and now_ns > start_ns + LOOPBACK_SETTLED_S * 1e9:
                errors.append(mapped[0] - now_ns)
                uncertainties.append(mapped[1])
        server.sendto(b"", agent.socket.getsockname())
    agent.thread.join()
    agent.socket.close()
    return accuracy(errors, uncertainties)


def median_us(work: Callable[[int], object], count: int = 2000) -> float:
    """Median cost of `work`, in microseconds."""
    times = []
    for k in range(count):
        start_ns = time.perf_counter_ns()
        work(k)
        times.append(time.perf_counter_ns() - start_ns)
    return float(np.median(times)) / 1e3


def costs_us() -> dict[str, float]:
    """Cost of a call of each part, with full windows."""
    sync = ClockSimulation(WanderingClock()).run(80).sync
    now_ns = START_NS + 10**12
    requests: list[ClockRequest] = []
    jitter_ns = np.random.default_rng(1).integers(0, 1_000_000, (2, 2000)).tolist()

    def receive(k: int) -> None:
        requests.append(sync.request(now_ns + k * 250_000_000))
        t1_ns = requests[-1].t1_ns
        agent_ns = t1_ns - 3 * 10**14 + jitter_ns[0][k]
        sync.receive(ClockReply(t1_ns, agent_ns, agent_ns), t1_ns + jitter_ns[0][k] + jitter_ns[1][k])

    clock, system = DeviceClock(), SystemClock(time.monotonic_ns, time.time_ns)

    def stamp_a_second(k: int) -> None:
        for frame in range(30 * k, 30 * k + 30):
            arrival_ns = frame * 1_000_000_000 // 30 + jitter_ns[0][frame % 2000]
            clock.stamp(frame * TICK_HZ // 30 % 2**32, arrival_ns)

    return {
        "receive_us": median_us(receive),
        "to_rig_us": median_us(lambda k: sync.to_rig(k)),
        "stamp_us": median_us(stamp_a_second, 300) / 30,  # the fit follows once in 30 frames
        "system_clock_us": median_us(lambda _: system.read()),
    }


def run() -> dict[str, Any]:
    """All figures."""
    return {
        "exchange": {name: exchange(*scenario) for name, scenario in EXCHANGES.items()},
        "device": {name: device(settings) for name, settings in DEVICES.items()},
        "loopback": loopback(),
        "cost": costs_us(),
    }


def table(figures: dict[str, Any]) -> str:
    """The accuracy table, as docs/performance.md shows it."""
    lines = [(f"exchange: {name}", row) for name, row in figures["exchange"].items()]
    lines.append(("exchange: real UDP over loopback", figures["loopback"]))
    lines += [(f"device: {name}", row) for name, row in figures["device"].items()]
    header = ["", "p50", "p99", "stated", "error / stated, rms", "interval p99"]
    rows = [
        [
            name,
            *(f"{row[key]:.0f} µs" for key in ("p50_us", "p99_us", "stated_us")),
            f"{row['normalised_rms']:.2f}",
            f"{row['interval_p99_us']:.1f} µs" if "interval_p99_us" in row else "",
        ]
        for name, row in lines
    ]
    return markdown_table(header, rows)


def main() -> None:
    """Print the tables."""
    figures = run()
    print(table(figures))
    print(", ".join(f"{name.removesuffix('_us')} {cost:.1f} us" for name, cost in figures["cost"].items()))


if __name__ == "__main__":
    main()
