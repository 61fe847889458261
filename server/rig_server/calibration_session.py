"""A calibration while the rig runs on: sets are handed to it, a thread solves, a person decides."""

from pathlib import Path

from rig_calib.rig_calibration import RigCalibration
from rig_protocol.errors import RigError
from rig_protocol.frames import PanoramicFrame
from rig_server.rig import Rig
from rig_server.session_view import Phase, SessionView

__all__ = ["CalibrationSession", "Phase", "SessionView"]


class CalibrationSession:
    """A calibration while the rig runs on: fed with sets, solved on a thread, decided on by a person.

    Any thread may call anything; nothing but `accept` and `close` waits.
    """

    def __init__(self, rig: Rig, folder: Path) -> None:
        """`folder`: where an accepted calibration is written."""
        self._rig, self._folder = rig, folder

    def start(self, camera: str | None = None, coached: bool = False, frames: int | None = None) -> None:
        """Begin; `camera` (name or id): find only this one anew, against the calibration in force.

        `coached`: go on with fresh sets until every overlap holds. `frames`: sets to use, else the settings'.
        RigError while one is running or waits for its decision, ConfigurationError for what cannot be done.
        """
        raise RigError("not there yet")

    def offer(self, panorama: PanoramicFrame) -> None:
        """Hand over a set; the taking thread does so with every one. Never waits."""

    def cancel(self) -> None:
        """Give up what is running; harmless when nothing is."""

    def accept(self) -> Path:
        """Write calibration.json, report.html, cloud.ply and panorama.png, and put the calibration in force.

        Takes some seconds: not for the thread that takes sets. A calibration.json that is overwritten stays
        as calibration-before.json. Returns the path of calibration.json. RigError when none is ready, or it
        fails its gate.
        """
        raise RigError("no calibration is ready")

    def reject(self) -> None:
        """Forget the result; RigError when none is ready."""

    @property
    def view(self) -> SessionView:
        """What it is at."""
        return SessionView()

    @property
    def candidate(self) -> RigCalibration | None:
        """The result that waits for its decision, for a preview; None in every other phase."""
        return None

    def close(self) -> None:
        """Give up what is running and end the thread; harmless when already closed."""
