"""One run of a calibration on a thread of its own, from the first set to a result, while the rig runs on."""

import logging
import threading
from dataclasses import dataclass

from rig_calib.rig_calibration import RigCalibration
from rig_protocol.errors import RigError
from rig_server.calibration_task import CalibrationTask, Estimate
from rig_server.capture_log import CaptureLog
from rig_server.coached_capture import CaptureCancelledError, coached_capture
from rig_server.metrics import RigStatus
from rig_server.offered_sets import OfferedSets
from rig_server.rig import Rig

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A result that waits for somebody to decide, and what its pictures are made of."""

    calibration: RigCalibration
    estimate: Estimate


class CalibrationRun:
    """Waits for the cameras, captures and solves from `start` on, until it has a `candidate` or is cancelled.

    `log` is at `ready` once there is a candidate, and at `failed` when there will be none.
    """

    def __init__(self, rig: Rig, task: CalibrationTask) -> None:
        self._rig, self._task = rig, task
        self.sets = OfferedSets(rig)
        self.log = CaptureLog(task.settings.capture.frames, rig.calibration)
        self.candidate: Candidate | None = None
        self._cancelled = threading.Event()
        self._thread = threading.Thread(target=self._run, name="calibration session", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def cancel(self) -> None:
        """End soon, without a result."""
        self._cancelled.set()

    def join(self, timeout_s: float) -> bool:
        """Wait for the end; False when it is not over then."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._wait_for_cameras()
            estimate = coached_capture(self.sets, self._task, self.log, self._cancelled)
            calibration = self._task.stamped(estimate, self._rig.hellos, self._rig.source)
        except CaptureCancelledError:
            return
        except RigError as error:
            self.log.failed(str(error))
        except Exception as error:  # the thread's boundary: the rig runs on
            logger.exception("a calibration has failed")
            self.log.failed(f"a programming error ended it, see the log: {error!r}")
        else:
            self.candidate = Candidate(calibration, estimate)
            self.log.ready()
        finally:
            self.sets.end_sets()
            if self.sets.passed_over:
                logger.info("the calibration did not keep up with %d sets", self.sets.passed_over)

    def _wait_for_cameras(self) -> None:
        settings = self._rig.settings
        expected = settings.expected_cameras or len(settings.cameras) or None

        def look(status: RigStatus) -> None:
            if self._cancelled.is_set():
                raise CaptureCancelledError
            self.log.connected(status.connected, expected)

        self._rig.wait_for_cameras(self._task.settings.capture.wait_s, look)
