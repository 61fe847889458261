"""Agent time to rig time: the server's side of the clock exchange (protocol/SPEC.md, section 8)."""

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rig_protocol.messages import ClockReply, ClockRequest

FAST_REQUESTS = 8
FAST_INTERVAL_NS = 20_000_000
REQUEST_INTERVAL_NS = 250_000_000
MAX_OUTSTANDING = 16
# 60 s: drift is seen well, and a crystal's own wander in that time is small.
MAX_SAMPLES = 240

# What two clocks read in Python threads are good for, even where no delay varies.
_READING_NS = 10_000.0
# Crystals are specified at 50 ppm each; this is the doubt before any drift was seen.
_DRIFT_PRIOR = 100e-6
_STEP_UNCERTAINTIES = 4
_STEP_MARGIN_NS = 1_000_000


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """Rig time = agent time + offset, as of the latest exchange.

    `uncertainty_ns` is the standard uncertainty of the offset now; `delay_ns` the least round trip seen.
    """

    offset_ns: int
    drift_ppm: float
    uncertainty_ns: int
    delay_ns: int
    samples: int


class _Sample(NamedTuple):
    agent_ns: int
    offset_ns: int
    delay_ns: int


@dataclass(frozen=True, slots=True)
class _Fit:
    """Offset as a line through the samples: origin, value and slope there, and their covariance."""

    agent_ns: int
    offset_ns: int
    correction_ns: float
    drift: float
    covariance: tuple[float, float, float]  # of (offset, drift): ns², ns, 1
    floor_ns: float

    def offset_at(self, agent_ns: int) -> tuple[int, float]:
        """Offset and its standard uncertainty at an agent time."""
        elapsed = float(agent_ns - self.agent_ns)
        value, mixed, slope = self.covariance
        variance = value + 2 * elapsed * mixed + elapsed * elapsed * slope + self.floor_ns**2
        return self.offset_ns + round(self.correction_ns + self.drift * elapsed), math.sqrt(variance)


class ClockSync:
    """Asks one agent for its time, estimates offset and drift, notices steps."""

    def __init__(self, now_ns: int) -> None:
        self._samples: deque[_Sample] = deque(maxlen=MAX_SAMPLES)
        self._outstanding: deque[int] = deque(maxlen=MAX_OUTSTANDING)
        self._fit: _Fit | None = None
        self._fast_left = FAST_REQUESTS
        self._last_request_ns = now_ns - REQUEST_INTERVAL_NS
        self.steps = 0

    @property
    def next_request_ns(self) -> int:
        """When the next request is due."""
        return self._last_request_ns + (FAST_INTERVAL_NS if self._fast_left else REQUEST_INTERVAL_NS)

    def request(self, now_ns: int) -> ClockRequest:
        """The request to send at `now_ns`."""
        self._outstanding.append(now_ns)
        self._last_request_ns = now_ns
        self._fast_left = max(0, self._fast_left - 1)
        return ClockRequest(now_ns)

    def hurry(self) -> None:
        """Ask soon: something does not agree with the estimate."""
        self._fast_left = max(1, self._fast_left)

    def receive(self, reply: ClockReply, now_ns: int) -> bool:
        """Take a reply that arrived at `now_ns`; False where it answers nothing or cannot be true."""
        delay_ns = (now_ns - reply.t1_ns) - (reply.t3_ns - reply.t2_ns)
        if reply.t1_ns not in self._outstanding or reply.t3_ns < reply.t2_ns or delay_ns < 0:
            return False
        self._outstanding.remove(reply.t1_ns)
        offset_ns = ((reply.t1_ns - reply.t2_ns) + (now_ns - reply.t3_ns)) // 2
        sample = _Sample((reply.t2_ns + reply.t3_ns) // 2, offset_ns, delay_ns)
        if self._contradicts(sample):
            self.steps += 1
            self._samples.clear()
            self._fast_left = FAST_REQUESTS
        self._samples.append(sample)
        self._fit = _fit(self._samples)
        return True

    def to_rig(self, agent_time_ns: int) -> tuple[int, int] | None:
        """Rig time and its standard uncertainty (ns) of an agent time; None before the first sample."""
        if self._fit is None:
            return None
        offset_ns, uncertainty_ns = self._fit.offset_at(agent_time_ns)
        return agent_time_ns + offset_ns, math.ceil(uncertainty_ns)

    @property
    def estimate(self) -> ClockEstimate | None:
        """The estimate as of the latest sample; None before the first."""
        if self._fit is None:
            return None
        offset_ns, uncertainty_ns = self._fit.offset_at(self._fit.agent_ns)
        least = min(sample.delay_ns for sample in self._samples)
        return ClockEstimate(
            offset_ns, self._fit.drift * 1e6, math.ceil(uncertainty_ns), least, len(self._samples)
        )

    def _contradicts(self, sample: _Sample) -> bool:
        """True when estimate and sample cannot both be right: a clock jumped."""
        if self._fit is None:
            return False
        expected_ns, uncertainty_ns = self._fit.offset_at(sample.agent_ns)
        allowed_ns = sample.delay_ns / 2 + _STEP_UNCERTAINTIES * uncertainty_ns + _STEP_MARGIN_NS
        return abs(sample.offset_ns - expected_ns) > allowed_ns


def _fit(samples: deque[_Sample]) -> _Fit:
    """Weighted least squares; the drift has a prior, so one sample is enough."""
    origin = samples[-1]
    elapsed = np.array([float(sample.agent_ns - origin.agent_ns) for sample in samples])
    offsets = np.array([float(sample.offset_ns - origin.offset_ns) for sample in samples])
    delays = np.array([float(sample.delay_ns) for sample in samples])
    least = float(delays.min())
    doubt = (delays - least) / 2
    weights = (_READING_NS + doubt) ** -2.0
    moments = [float(weights @ elapsed**power) for power in (0, 1, 2)]
    right = (float(weights @ offsets), float(weights @ (offsets * elapsed)))
    value, mixed, slope = moments[0], moments[1], moments[2] + _DRIFT_PRIOR**-2
    determinant = value * slope - mixed * mixed
    unseen = float(np.median(doubt)) / math.sqrt(len(samples))
    asymmetry = least / 2 / math.sqrt(3)
    return _Fit(
        agent_ns=origin.agent_ns,
        offset_ns=origin.offset_ns,
        correction_ns=(slope * right[0] - mixed * right[1]) / determinant,
        drift=(value * right[1] - mixed * right[0]) / determinant,
        covariance=(slope / determinant, -mixed / determinant, value / determinant),
        floor_ns=math.hypot(unseen, asymmetry),
    )
