"""Stages of a calibration: how long each took, and how far the whole is."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from numba.core.event import Event, Listener, install_listener
from threadpoolctl import ThreadpoolController

Progress = Callable[[str, float], None]
"""Told the stage and the share of the whole that is done, 0 to 1."""

_COMPILING = "compiling, first run only"

# Rough shares of the whole, so that a progress bar moves evenly.
_SHARES = {"features": 0.4, "matching": 0.1, "registration": 0.3, "optimisation": 0.2}


class Stages:
    """Times the stages and tells their progress."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress = progress
        self._seconds = {"load": 0.0} | dict.fromkeys(_SHARES, 0.0)
        self._libraries = ThreadpoolController()
        self._current = ""
        self._share = 0.0
        self._done = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time one stage, whose linear algebra has one thread.

        Its matrices are small: threads would wait for each other, with the cores in their hands.
        """
        self._current, self._share = name, 0.0
        self.tell(0.0)
        started_s = time.perf_counter()
        listener = _CompilationListener(self)
        with install_listener("numba:compile", listener), self._libraries.limit(limits=1, user_api="blas"):
            yield
        self._seconds[name] += time.perf_counter() - started_s
        self.tell(1.0)
        self._done += _SHARES[name]

    def tell(self, share: float) -> None:
        """Tell that this share of the current stage is done."""
        self._share = share
        self._say(self._current)

    def tell_compilation(self, under_way: bool) -> None:
        """Tell that the stage waits for the compiler, or goes on."""
        self._say(_COMPILING if under_way else self._current)

    def seconds(self) -> dict[str, float]:
        """Seconds of every stage, and their total; loading is the caller's."""
        return self._seconds | {"total": sum(self._seconds.values())}

    def _say(self, what: str) -> None:
        if self._progress is not None:
            self._progress(what, self._done + self._share * _SHARES[self._current])


class _CompilationListener(Listener):
    """Loops are compiled where they are first called, by an installation's first run, for some seconds."""

    def __init__(self, stages: Stages) -> None:
        self._stages = stages
        self._depth = 0

    def on_start(self, _event: Event) -> None:
        self._depth += 1
        self._stages.tell_compilation(under_way=True)

    def on_end(self, _event: Event) -> None:
        self._depth -= 1
        if not self._depth:
            self._stages.tell_compilation(under_way=False)
