"""Stages of a calibration: how long each took, and how far the whole is."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[str, float], None]
"""Told the stage and the share of the whole that is done, 0 to 1."""

# Rough shares of the whole, so that a progress bar moves evenly.
_SHARES = {"features": 0.4, "matching": 0.1, "registration": 0.3, "optimisation": 0.2}


class Stages:
    """Times the stages and tells their progress."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress = progress
        self._seconds = {"load": 0.0} | dict.fromkeys(_SHARES, 0.0)
        self._current = ""
        self._done = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time one stage."""
        self._current = name
        self.tell(0.0)
        started_s = time.perf_counter()
        yield
        self._seconds[name] += time.perf_counter() - started_s
        self.tell(1.0)
        self._done += _SHARES[name]

    def tell(self, share: float) -> None:
        """Tell that this share of the current stage is done."""
        if self._progress is not None:
            self._progress(self._current, self._done + share * _SHARES[self._current])

    def seconds(self) -> dict[str, float]:
        """Seconds of every stage, and their total; loading is the caller's."""
        return self._seconds | {"total": sum(self._seconds.values())}
