"""Samples of the last seconds."""

from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class SampleWindow(Generic[T]):
    """Keeps samples at most `window_ns` old, and the last one before: at most one each `spacing_ns`.

    So however often somebody asks, window / spacing + 2 samples are held.
    """

    def __init__(self, window_ns: int, spacing_ns: int) -> None:
        self._window_ns, self._spacing_ns = window_ns, spacing_ns
        self._kept: deque[tuple[int, T]] = deque()

    def add(self, sample: T, now_ns: int) -> list[tuple[int, T]]:
        """Samples with their times, oldest first: those of the window, the last one before it, this one."""
        while len(self._kept) > 1 and self._kept[1][0] <= now_ns - self._window_ns:
            self._kept.popleft()
        samples = [*self._kept, (now_ns, sample)]
        if not self._kept or now_ns - self._kept[-1][0] >= self._spacing_ns:
            self._kept.append((now_ns, sample))
        return samples
