"""A histogram of durations: fixed buckets, exact counts, quantiles by interpolation."""

import threading
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class HistogramSnapshot:
    """The counts at one moment; bucket i ends at `bounds_ns[i]`, included, and the last one never."""

    bounds_ns: tuple[int, ...]
    counts: tuple[int, ...]
    sum_ns: int

    @property
    def count(self) -> int:
        """How many durations were observed."""
        return sum(self.counts)

    def since(self, earlier: "HistogramSnapshot") -> "HistogramSnapshot":
        """What was observed after an earlier snapshot of the same histogram."""
        counts = tuple(now - then for now, then in zip(self.counts, earlier.counts, strict=True))
        return HistogramSnapshot(self.bounds_ns, counts, self.sum_ns - earlier.sum_ns)

    def quantile_ns(self, share: float) -> float | None:
        """The duration that a `share` of all do not exceed, as if each bucket were evenly filled.

        Off by less than its bucket's width. None when nothing was observed; beyond the last bound that bound,
        which then means at least.
        """
        rank = share * self.count
        below = 0
        for index, count in enumerate(self.counts):
            if count and below + count >= rank:
                if index == len(self.bounds_ns):
                    return float(self.bounds_ns[-1])
                lower = self.bounds_ns[index - 1] if index else 0
                part = max(rank - below, 0.0) / count
                return lower + part * (self.bounds_ns[index] - lower)
            below += count
        return None


class Histogram:
    """Counts durations from any thread; an observation costs about a microsecond."""

    def __init__(self, bounds_ns: Sequence[int]) -> None:
        """`bounds_ns`: positive and ascending."""
        if not bounds_ns or any(b <= a for a, b in zip((0, *bounds_ns), bounds_ns, strict=False)):
            raise ValueError(f"bounds {bounds_ns} are not positive and ascending")
        self._bounds_ns = tuple(bounds_ns)
        self._lock = threading.Lock()  # += on a list's item is no single step
        self._counts = [0] * (len(self._bounds_ns) + 1)
        self._sum_ns = 0

    def observe(self, duration_ns: int) -> None:
        """Count one duration; a negative one, as clocks give within their uncertainty, counts as 0."""
        duration_ns = max(duration_ns, 0)
        index = bisect_left(self._bounds_ns, duration_ns)
        with self._lock:
            self._counts[index] += 1
            self._sum_ns += duration_ns

    def snapshot(self) -> HistogramSnapshot:
        """The counts now."""
        with self._lock:
            return HistogramSnapshot(self._bounds_ns, tuple(self._counts), self._sum_ns)
