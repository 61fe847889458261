"""The watching sink: looks at some of the sets, on a thread of its own, for cameras that moved."""

import contextlib
import logging
import os
import queue
import threading
from collections.abc import Callable

from rig_calib.drift.rig_watch import RigWatch
from rig_calib.drift.watch import DriftStatus
from rig_calib.drift.words import camera_names, moved_message
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.frames import PanoramicFrame
from rig_protocol.rig_folder import RigDescription
from rig_protocol.troubleshooting import Topic, see
from rig_server.metrics import DriftReport

logger = logging.getLogger(__name__)

_NICENESS = 10  # whatever else the server does comes first
_WAITING = 1  # a set holds 11 MB, and an older one says nothing that a newer one does not

Work = tuple[RigDescription, PanoramicFrame]


class WatchSink:
    """Watches from `start` to `stop`. Offering never waits: a set that finds it busy is passed over."""

    def __init__(self, calibration: RigCalibration, every: int) -> None:
        """Looks at one set in `every`."""
        self._every = every
        self._names = camera_names(calibration)
        self._watch = RigWatch(calibration)
        self._work: queue.Queue[Work | None] = queue.Queue(_WAITING)
        self._thread = threading.Thread(target=self._run, name="drift watch", daemon=True)
        self._stopping = threading.Event()
        self._offered = 0
        self._moved: frozenset[int] = frozenset()
        self._status = DriftStatus()
        self._passed_over = 0
        self._failure: Exception | None = None

    def report(self) -> DriftReport:
        """What is known now; any thread may ask."""
        failure = None if self._failure is None else repr(self._failure)
        return DriftReport(self._status, self._names, self._passed_over, failure)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End, after the look that is being taken; harmless when already ended, or never begun."""
        self._stopping.set()
        if self._thread.is_alive():
            with contextlib.suppress(queue.Full):  # then it wakes up anyway
                self._work.put_nowait(None)
            self._thread.join()

    def offer(self, panorama: PanoramicFrame, description: Callable[[], RigDescription]) -> None:
        """Look at the set, if it is one's turn and there is time; `description` is asked for only then."""
        self._offered += 1
        if self._offered % self._every or self._stopping.is_set():
            return
        if self._work.full():  # nobody else puts anything in
            self._passed_over += 1
        else:
            self._work.put_nowait((description(), panorama))

    def _run(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # Linux alone has priorities of threads
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
        try:
            while (work := self._work.get()) is not None and not self._stopping.is_set():
                self._watch.take(*work)
                self._tell(self._watch.status())
        except Exception as failure:  # the rig goes on, and says that nobody watches any more
            self._failure = failure
            logger.exception("the drift watch has ended")

    def _tell(self, status: DriftStatus) -> None:
        """Say in the log which cameras are newly found to have moved, or to be in place again."""
        moved = {camera.camera: camera for camera in status.moved}
        for k in sorted(moved.keys() - self._moved):
            logger.error("%s", moved_message(moved[k], self._names), extra=see(Topic.CAMERA_MOVED))
        for k in sorted(self._moved - moved.keys()):
            logger.warning("%s is in its place again", self._names.get(k, k))
        self._moved = frozenset(moved)
        self._status = status
