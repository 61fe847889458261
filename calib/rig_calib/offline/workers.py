"""Workers that take a capture batch by batch; what comes out does not depend on how many they are."""

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol, TypeVar

from rig_calib.offline.capture import Capture
from rig_protocol.errors import ConfigurationError
from rig_protocol.frames import PanoramicFrame

logger = logging.getLogger(__name__)

Result = TypeVar("Result")
Tell = Callable[[float], None]
"""Told the share that is done, 0 to 1."""

_INSTALL = "pip install 'kinect-rig[offline]'"


@dataclass(frozen=True, slots=True)
class Batch:
    """Some positions of a capture: what a worker takes at a time."""

    capture: Capture
    positions: range

    def panoramas(self) -> Iterator[PanoramicFrame]:
        """Their panoramic frames, complete or not, one by one; one without any image is left out.

        DataError where the file is damaged.
        """
        return self.capture.read(self.positions)


class Workers(Protocol):
    """Whoever does the work."""

    def map(
        self, work: Callable[[Batch], Result], batches: Sequence[Batch], tell: Tell | None = None
    ) -> Iterator[Result]:
        """The result of every batch, in the batches' order, no more than a few ahead of who takes them.

        `work` must be importable by other processes (a function of a module, or a `functools.partial` of
        one), and its result must not depend on what the worker did before. What it raises is raised here.
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
    """`count` processes of this machine (default: one a core), or a Dask cluster at `scheduler`.

    Processes start with the first work that has more than one batch. ConfigurationError where Dask is not
    installed or nobody answers; without Dask and without a wish, the work is done in this process.
    """
    if count is not None and scheduler is not None:
        raise ConfigurationError("--workers counts processes of this machine: leave it out with --scheduler")
    wanted = count or len(os.sched_getaffinity(0))
    if scheduler is None and wanted == 1:
        yield ThisProcess()
        return
    try:
        from rig_calib.offline.dask_workers import open_cluster, open_processes
    except ModuleNotFoundError as error:
        if count is not None or scheduler is not None:
            raise ConfigurationError(
                f"several workers need the Python package {error.name}: {_INSTALL}"
            ) from error
        logger.warning("one core does all the work; for the others: %s", _INSTALL)
        yield ThisProcess()
        return
    with open_processes(wanted) if scheduler is None else open_cluster(scheduler) as workers:
        yield workers
