"""Offset and drift of two clocks from noisy samples: a weighted line through the last minute."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# 60 s of the clock exchange: drift is seen well, and a crystal's own wander in that time is small.
MAX_SAMPLES = 240

# What two clocks read in Python threads are good for, even where no delay varies.
_READING_NS = 10_000.0
# Crystals are specified at 50 ppm each; this is the doubt before any drift was seen.
_DRIFT_PRIOR = 100e-6
# How far the drift wanders within the window, with the temperature: what an older sample is good for.
_WANDER = 1e-6


@dataclass(frozen=True, slots=True)
class OffsetLine:
    """Offset = a line over agent time: origin, value and slope there, and their covariance."""

    agent_ns: int
    offset_ns: int
    drift: float
    covariance: tuple[float, float, float]  # of (offset, drift): ns², ns, 1
    unseen_ns: float  # how much the least delay seen is above the least possible, about

    def at(self, agent_ns: int) -> tuple[int, float]:
        """Offset at an agent time, and its standard uncertainty but for the path's asymmetry (ns)."""
        elapsed = float(agent_ns - self.agent_ns)
        value, mixed, slope = self.covariance
        variance = value + 2 * elapsed * mixed + elapsed * elapsed * slope
        return self.offset_ns + round(self.drift * elapsed), math.sqrt(variance)


class OffsetFilter:
    """The last MAX_SAMPLES samples since `clear`, and the line through them.

    A round trip that takes e longer than the least one errs by up to e/2, evenly (for exponential jitter
    both ways exactly so). Weights fall with the third power of that doubt, not the second: queues often
    form in one direction only, and averaging does not remove a bias.
    """

    def __init__(self) -> None:
        """No samples yet."""
        # Rows: agent time, offset (both since the first sample, so that a float holds them), round trip.
        self._samples: NDArray[np.float64] = np.zeros((3, MAX_SAMPLES))
        self._first: tuple[int, int] = (0, 0)
        self._added = 0
        self.least_delay_ns = 0

    def __len__(self) -> int:
        """Samples in the window."""
        return min(self._added, MAX_SAMPLES)

    def clear(self) -> None:
        """Forget everything: a clock jumped."""
        self._added = 0

    def add(self, agent_ns: int, offset_ns: int, delay_ns: int) -> OffsetLine:
        """Take a sample; the line as of now, with its origin at this sample."""
        if not self._added:
            self._first = (agent_ns, offset_ns)
        since_ns, change_ns = float(agent_ns - self._first[0]), float(offset_ns - self._first[1])
        self._samples[:, self._added % MAX_SAMPLES] = since_ns, change_ns, delay_ns
        self._added += 1
        elapsed, offsets, delays = self._samples[:, : len(self)]
        self.least_delay_ns = int(delays.min())
        elapsed = elapsed - since_ns
        unseen_ns = _unseen(delays)
        doubt = delays - self.least_delay_ns + unseen_ns
        variances = _READING_NS**2 + doubt**2 / 12 + (_WANDER * elapsed) ** 2
        value, drift, covariance = _fit(elapsed, offsets - change_ns, variances)
        return OffsetLine(agent_ns, offset_ns + round(value), drift, covariance, unseen_ns)


def _unseen(delays: NDArray[np.float64]) -> float:
    """How much even the least delay seen is too long: about the jitter over the root of their number.

    The jitter is what the median is above the least; few samples hardly show it: it may be the whole delay.
    """
    count, least = len(delays), float(delays.min())
    jitter = float(np.partition(delays, count // 2)[count // 2]) - least
    return (jitter + least / count) / math.sqrt(count)


def _fit(
    elapsed: NDArray[np.float64], offsets: NDArray[np.float64], variances: NDArray[np.float64]
) -> tuple[float, float, tuple[float, float, float]]:
    """Least squares: offset at 0, drift, their covariance. The drift has a prior: one sample is enough."""
    # The third power of the doubt, scaled so that the best sample counts as it would alone.
    weights = math.sqrt(variances.min()) / (variances * np.sqrt(variances))
    weighted = weights * elapsed
    value, mixed, slope = float(weights.sum()), float(weighted.sum()), float(weighted @ elapsed)
    slope += _DRIFT_PRIOR**-2
    determinant = value * slope - mixed * mixed
    covariance = (slope / determinant, -mixed / determinant, value / determinant)
    right = (float(weights @ offsets), float(weighted @ offsets))
    return (
        covariance[0] * right[0] + covariance[1] * right[1],
        covariance[1] * right[0] + covariance[2] * right[1],
        covariance,
    )
