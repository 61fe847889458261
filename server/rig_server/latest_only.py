"""A thread that works on the latest of what it is offered, and lets everything else pass."""

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

logger = logging.getLogger(__name__)

_PUNCTUAL = 0.85  # of the time between two: a stream's jitter costs no turn

Item = TypeVar("Item")


class LatestOnly(Generic[Item]):
    """Runs `work` from `start` to `stop`. Offering never waits; an item that nobody took yet is replaced.

    `every_s`: about so long between the beginnings of two works; what is offered sooner passes, for it would
    be old when its turn comes. `niceness`: of the thread. An error of `work` is logged and shown by
    `failure`; the next item is tried again. `passed`: items that were not worked on.
    """

    def __init__(self, name: str, work: Callable[[Item], None], every_s: float, niceness: int) -> None:
        self._name, self._work, self._every_s, self._niceness = name, work, every_s, niceness
        self._changed = threading.Condition()  # guards what follows
        self._item: Item | None = None
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._next_s = 0.0
        self.passed = 0
        self.failure: str | None = None

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End, after the work that is being done; harmless when already ended, or never begun."""
        with self._changed:
            self._stopping = True
            self._item = None
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join()

    def offer(self, item: Item) -> None:
        """Work on this next."""
        with self._changed:
            early = time.monotonic() < self._next_s
            self.passed += early or self._item is not None
            if not (early or self._stopping):
                self._item = item
                self._changed.notify()

    def _run(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # Linux alone has priorities of threads
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), self._niceness)
        while (item := self._next()) is not None:
            try:
                self._work(item)
            except Exception as failure:  # the rig goes on
                if self.failure is None:
                    logger.exception("%s has failed", self._name)
                self.failure = repr(failure)
            else:
                self.failure = None
            del item  # a set holds 11 MB

    def _next(self) -> Item | None:
        """The next item; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._stopping or self._item is not None)
            item, self._item = self._item, None
            self._next_s = time.monotonic() + _PUNCTUAL * self._every_s
            return item
