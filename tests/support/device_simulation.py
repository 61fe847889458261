"""A Kinect's tick counter and what delays its frames, in virtual time."""

import math
import random
from dataclasses import dataclass, field
from typing import NamedTuple

from rig_agent.sources.device_clock import TICK_HZ, DeviceClock

FRAME_NS = 1e9 / 30


@dataclass(frozen=True, slots=True)
class FrameDelays:
    """From the sensor's stamp to the driver's callback: what all frames take, the USB transfer, the host."""

    least_ns: int = 400_000
    transfer_ns: int = 2_000_000
    host_ns: int = 300_000  # mean of the exponential part: interrupts, the interpreter's lock
    spike_ns: int = 50_000_000
    spikes: float = 0.01
    beats: bool = False  # the transfer's delay follows from the bus' own 2-ms grid instead of chance

    def delay_ns(self, true_ns: float, random_source: random.Random) -> int:
        """Delay of a frame that the device finished at a true time."""
        on_bus_ns = -true_ns % self.transfer_ns if self.beats else random_source.uniform(0, self.transfer_ns)
        host_ns = random_source.expovariate(1 / self.host_ns) if self.host_ns else 0
        spike_ns = self.spike_ns * random_source.random() if random_source.random() < self.spikes else 0
        return self.least_ns + round(on_bus_ns + host_ns + spike_ns)


class StampedFrame(NamedTuple):
    """A frame as the agent dates it; the truth is when the device finished it."""

    true_ns: int
    stamp_ns: int
    uncertainty_ns: int
    arrival_ns: int


@dataclass
class DeviceSimulation:
    """A device at 30 Hz whose crystal is off and wanders, stamped by a DeviceClock."""

    drift_ppm: float = 0.0
    swing_ppm: float = 0.0
    period_s: float = 300.0
    delays: FrameDelays = FrameDelays()
    seed: int = 0
    first_tick: int = 0
    now_ns: float = 5e12
    frames: list[StampedFrame] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.clock = DeviceClock()
        self._random = random.Random(self.seed)
        self._start_ns = self.now_ns
        self._last_arrival_ns = 0

    def run(self, seconds: float, silent: bool = False) -> list[StampedFrame]:
        """The frames of so much time; silent: the device goes on, but nothing arrives."""
        before = len(self.frames)
        end_ns = self.now_ns + seconds * 1e9
        while self.now_ns < end_ns:
            if not silent:
                self._frame()
            self.now_ns += FRAME_NS / (1 + self.drift_ppm * 1e-6)
        return self.frames[before:]

    def ticks(self) -> int:
        """The device's counter now."""
        elapsed_s, turn = (self.now_ns - self._start_ns) / 1e9, 2 * math.pi / self.period_s
        swung_s = self.swing_ppm * 1e-6 * (1 - math.cos(turn * elapsed_s)) / turn
        device_s = elapsed_s * (1 + self.drift_ppm * 1e-6) + swung_s
        return (self.first_tick + round(device_s * TICK_HZ)) % 2**32

    def _frame(self) -> None:
        arrival_ns = round(self.now_ns) + self.delays.delay_ns(self.now_ns, self._random)
        arrival_ns = max(arrival_ns, self._last_arrival_ns + 50_000)  # one thread takes them in turn
        self._last_arrival_ns = arrival_ns
        stamped = self.clock.stamp(self.ticks(), arrival_ns)
        self.frames.append(StampedFrame(round(self.now_ns), *stamped, arrival_ns))
