"""A calibration while the rig runs on: sets are handed to it, a thread solves, a person decides."""

import threading
from pathlib import Path

from rig_calib.outputs import NAME, keep_before, make_output_folder, write_outputs
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.frames import PanoramicFrame
from rig_protocol.troubleshooting import Topic
from rig_server.calibration_run import CalibrationRun, Candidate
from rig_server.calibration_task import CalibrationTask
from rig_server.capture_log import CaptureLog
from rig_server.config import MAX_SETS
from rig_server.rig import Rig
from rig_server.session_view import Phase, SessionView

__all__ = ["CalibrationSession", "Phase", "SessionView"]

_RUNNING = (Phase.WAITING, Phase.COLLECTING, Phase.SOLVING)
_PATIENCE_S = 5.0  # for a run that was given up: it may be switching projectors on again


class CalibrationSession:
    """A calibration while the rig runs on: fed with sets, solved on a thread, decided on by a person.

    Any thread may call anything. `offer`, `view` and `candidate` never wait.
    """

    def __init__(self, rig: Rig, folder: Path) -> None:
        """`folder`: where an accepted calibration is written."""
        self._rig, self._folder = rig, folder
        self._deciding = threading.Lock()  # one person at a time
        self._run: CalibrationRun | None = None
        self._given_up: CalibrationRun | None = None
        self._message: str | None = None
        self._looked_on: CaptureLog | None = None

    def look_on(self, log: CaptureLog) -> None:
        """Show a calibration that others make, which can then be neither started nor decided on here."""
        self._looked_on = log

    def start(self, camera: str | None = None, coached: bool = False, frames: int | None = None) -> None:
        """Begin; `camera` (name or id): find only this one anew, against the calibration in force.

        `coached`: go on with fresh sets until every overlap holds. `frames`: sets to use, else the settings'.
        RigError while one is running or waits for its decision, ConfigurationError for what cannot be done.
        """
        with self._deciding:
            self._refuse_while_busy()
            task = self._task(camera, coached, frames)
            make_output_folder(self._folder)  # what cannot be written later is told now
            if self._given_up is not None and not self._given_up.join(_PATIENCE_S):
                raise RigError("the calibration that was given up is still ending: try again in some seconds")
            self._run, self._given_up = CalibrationRun(self._rig, task), None
            self._run.start()

    def offer(self, panorama: PanoramicFrame) -> None:
        """Hand over a set; the taking thread does so with every one. Never waits."""
        run = self._run
        if run is not None:
            run.sets.offer(panorama)

    def cancel(self) -> None:
        """Give up what is running; harmless when nothing is."""
        with self._deciding:
            run = self._run
            if run is not None and run.log.view.phase in _RUNNING:
                run.cancel()
                self._given_up = run
                self._end("the calibration was given up")

    def accept(self) -> Path:
        """Write calibration.json, report.html, cloud.ply and panorama.png, and put the calibration in force.

        Takes some seconds: not for the thread that takes sets. A calibration.json that is overwritten stays
        as calibration-before.json. Returns the path of calibration.json. RigError when none is ready, when it
        fails its gate, and when it cannot be written: it then waits on.
        """
        with self._deciding:
            run, candidate = self._ready()
            calibration, missed = candidate.calibration, candidate.estimate.missed
            if calibration.failures:
                raise RigError(
                    f"the calibration fails its gate, reject it: {'; '.join(calibration.failures)}",
                    Topic.CALIBRATION_REFUSED,
                )
            self._write(run, candidate)
            self._rig.put_in_force(calibration)
            path = self._folder / NAME
            self._end(f"{path} is in force" + (f"; it misses its target: {missed}" if missed else ""))
            return path

    def reject(self) -> None:
        """Forget the result; RigError when none is ready."""
        with self._deciding:
            self._ready()
            self._end("the calibration was rejected; what was in force before still is")

    @property
    def view(self) -> SessionView:
        """What it is at."""
        run, looked_on = self._run, self._looked_on
        if looked_on is not None:
            return looked_on.view
        return SessionView(message=self._message) if run is None else run.log.view

    @property
    def candidate(self) -> RigCalibration | None:
        """The result that waits for its decision, for a preview; None in every other phase."""
        run = self._run
        return None if run is None or run.candidate is None else run.candidate.calibration

    def close(self) -> None:
        """Give up what is running and wait for its thread; harmless when already closed."""
        self.cancel()
        if self._given_up is not None:
            self._given_up.join(_PATIENCE_S)

    def _refuse_while_busy(self) -> None:
        self._refuse_on_looking()
        phase = self.view.phase
        if phase in _RUNNING:
            raise RigError("a calibration is running: wait for it, or cancel it")
        if phase is Phase.READY:
            raise RigError("a calibration is ready: accept or reject it first")

    def _refuse_on_looking(self) -> None:
        if self._looked_on is not None:
            raise RigError("this server was started to calibrate once: it writes the result by itself")

    def _task(self, camera: str | None, coached: bool, frames: int | None) -> CalibrationTask:
        settings = self._rig.settings
        if frames is not None:
            if not 1 <= frames <= MAX_SETS:
                raise ConfigurationError(f"a calibration takes 1 to {MAX_SETS} sets, not {frames}")
            capture = settings.capture.model_copy(update={"frames": frames})
            settings = settings.model_copy(update={"capture": capture})
        if settings.capture.projector_groups > 1 and self._rig.source != "udp":
            raise ConfigurationError(
                "projector groups need a live rig: the projectors of a recording cannot be told"
            )
        if camera is None:
            return CalibrationTask.whole_rig(settings, coached)
        known = self._rig.calibration
        if known is None:
            raise ConfigurationError(
                "no calibration is in force to find one camera anew in: calibrate the whole rig"
            )
        return CalibrationTask.one_camera(settings, known, camera, coached)

    def _ready(self) -> tuple[CalibrationRun, Candidate]:
        self._refuse_on_looking()
        run = self._run
        if run is None or run.candidate is None:
            raise RigError("no calibration is ready: there is nothing to accept or reject")
        return run, run.candidate

    def _write(self, run: CalibrationRun, candidate: Candidate) -> None:
        result = candidate.estimate.result
        try:
            keep_before(self._folder)
            write_outputs(
                self._folder,
                candidate.calibration,
                candidate.estimate.views,
                result.evidence,
                result.poses_before,
                run.log.writing,
            )
        except OSError as error:
            raise RigError(f"{self._folder} cannot be written to: {error.strerror}") from error

    def _end(self, message: str) -> None:
        """Nothing runs, nothing is ready; the message first, for whoever looks meanwhile."""
        self._message = message
        self._run = None
