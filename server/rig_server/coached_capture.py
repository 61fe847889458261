"""Panoramic frames collected while a background thread calibrates on those that are in."""

import threading
import time
from collections import deque
from functools import partial

from rig_protocol.frames import PanoramicFrame
from rig_server.background_work import BackgroundWork
from rig_server.calibration_task import CalibrationTask, Estimate
from rig_server.coach import Coach
from rig_server.grouped_sets import GroupableRig, SetSource, sets_of
from rig_server.sinks.calibrate import CalibrateSink

_POLL_S = 0.25


class CaptureCancelledError(Exception):
    """Somebody wants no result any more."""


def coached_capture(
    rig: GroupableRig, task: CalibrationTask, coach: Coach, cancelled: threading.Event | None = None
) -> Estimate:
    """Collect sets and calibrate on them; a coached task goes on with fresh sets until it is content.

    Ends the rig's sets as soon as it needs no more. RigError when no frame comes, or when the calibration's
    input is unusable; CaptureCancelledError soon after `cancelled` is set.
    """
    cancelled = cancelled or threading.Event()
    with BackgroundWork[Estimate]("calibration") as work, sets_of(rig, task.settings.capture) as sets:
        while True:
            estimate = _Round(sets, task, coach, work, cancelled).run()
            if not task.coached or task.contents(estimate):
                return estimate
            _skip_waiting_sets(rig)
            if sets.ended:  # nobody can hang a pattern into a recording
                return estimate


class _Round:
    """K complete sets, with an estimate on the first 1, 2, 4, ... of them, and one on all at the end.

    With a target every estimate counts: the first that meets it ends the round, whenever its sets came, so
    that a recording gives the same result as the capture did. Without one, they are for the coach only, and
    what is out of date is left out.
    """

    def __init__(
        self,
        rig: SetSource,
        task: CalibrationTask,
        coach: Coach,
        work: BackgroundWork[Estimate],
        cancelled: threading.Event,
    ) -> None:
        capture = task.settings.capture
        self._rig, self._task, self._coach, self._work = rig, task, coach, work
        self._cancelled = cancelled
        self._sink = CalibrateSink(capture.frames, rig.description.camera_ids)
        self._due = deque(doublings(capture.frames))
        self._until_s = time.monotonic() + capture.wait_s
        self._wanted = True
        self._final = False

    def run(self) -> Estimate:
        """The first estimate that is the last of the round or contents the task's target."""
        while not self._cancelled.is_set():
            if self._wanted:
                self._collect()
            estimate = self._work.take(0.0 if self._wanted else _POLL_S)
            if estimate is not None:
                last = self._final or (self._task.target is not None and self._task.contents(estimate))
                self._coach.show(estimate, last)
                if last:
                    return estimate
            self._go_on()
        raise CaptureCancelledError

    def _collect(self) -> None:
        panorama = self._rig.next_panorama(_POLL_S)
        more = True if panorama is None else self._sink.take(panorama)
        self._wanted = more and not self._rig.ended and time.monotonic() < self._until_s
        if not (self._wanted or self._task.coached):
            self._rig.end_sets()  # decoding, and simulated agents, would only slow down what follows
        self._coach.collected(self._sink.complete, self._task.settings.capture.frames)

    def _go_on(self) -> None:
        """Begin the next estimate when it is due and the one before has ended."""
        for_coach_only = self._task.target is None
        if self._work.busy:
            if for_coach_only and not self._wanted and not self._final:
                self._work.give_up()
            return
        if for_coach_only:
            while len(self._due) > 1 and self._due[1] <= self._sink.complete:
                self._due.popleft()
        if self._due and self._due[0] <= self._sink.complete and not (for_coach_only and not self._wanted):
            self._start(self._sink.first(self._due.popleft()), ())
        elif not self._wanted:
            self._final = True
            self._start(*self._sink.chosen())

    def _start(self, panoramas: list[PanoramicFrame], warnings: tuple[str, ...]) -> None:
        self._coach.begun(len(panoramas), self._final)
        work = partial(self._task.estimate, self._rig.description, panoramas, warnings)
        self._work.start(work, self._coach.tell)


def doublings(count: int) -> list[int]:
    """1, 2, 4, ... below `count`."""
    return [1 << k for k in range(count.bit_length()) if 1 << k < count]


def _skip_waiting_sets(rig: SetSource) -> None:
    """Sets that came before now show the room as it was."""
    while not rig.ended and rig.next_panorama(0.0) is not None:
        continue
