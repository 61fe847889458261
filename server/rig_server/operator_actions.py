"""What a person can have the rig do, from whatever surface: each action answers with a sentence."""

from rig_server.calibration_session import CalibrationSession
from rig_server.rig import Rig


class RigActions:
    """Each action returns a sentence for the person, or raises RigError whose text is one; for any thread.

    A camera is given by its name or id; None is every connected one. Controls wait for the agents' answers.
    """

    def __init__(self, rig: Rig, session: CalibrationSession) -> None:
        self._rig, self._session = rig, session

    def identify(self, camera: str | int | None) -> str:
        """Have the lamp blink for ten seconds; returns at once when it does."""
        return ""

    def expose(self, camera: str | int | None, auto: bool) -> str:
        """Let the colour camera adapt its exposure, or hold the one that it has found."""
        return ""

    def start_recording(self, name: str | None = None) -> str:
        """Record to a new file in `[recording] folder`, by default named by date and time."""
        return ""

    def stop_recording(self) -> str:
        """End the recording."""
        return ""

    def start_calibration(
        self, camera: str | None = None, coached: bool = False, frames: int | None = None
    ) -> str:
        """Begin to calibrate while the rig runs on; of one camera alone where one is given."""
        self._session.start(camera, coached, frames)
        return ""

    def cancel_calibration(self) -> str:
        """Give up the calibration that runs."""
        return ""

    def accept_calibration(self) -> str:
        """Write the calibration that is ready and put it in force; takes some seconds."""
        self._session.accept()
        return ""

    def reject_calibration(self) -> str:
        """Forget the calibration that is ready."""
        return ""
