"""What a person can have the rig do, from whatever surface: each action answers with a sentence."""

import logging
import re
import threading
from collections.abc import Collection
from datetime import datetime
from pathlib import Path

from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.events import Outcome
from rig_protocol.messages import ControlValue
from rig_server.calibration_session import CalibrationSession
from rig_server.coach import counted
from rig_server.control_catalogue import IDENTIFYING, ORDINARY
from rig_server.operator_requests import find_camera_id
from rig_server.rig import Rig
from rig_server.status_words import recorded

logger = logging.getLogger(__name__)

_SUFFIX = ".mcap"
_MAX_NAME = 100  # characters; file systems take 255 bytes
_PART = re.compile(r"\.\d{3,}$")  # how the further parts of a take are named

Cameras = Collection[int] | None


class RigActions:
    """Each action returns a sentence for the person, or raises RigError whose text is one; for any thread.

    A camera is given by its name or id; None is every connected one. Controls wait for the agents' answers.
    """

    def __init__(self, rig: Rig, session: CalibrationSession, identify_s: float = 10.0) -> None:
        """`identify_s`: for how long a lamp blinks."""
        self._rig, self._session = rig, session
        self._identify_s = identify_s
        self._blinking = threading.Lock()  # guards the timers
        self._timers: dict[int | None, threading.Timer] = {}

    def identify(self, camera: str | int | None = None) -> str:
        """Have the lamp blink red and yellow for a while; returns as soon as it does."""
        camera_id = self._camera_id(camera)
        self._control(camera_id, "led", IDENTIFYING)
        timer = threading.Timer(self._identify_s, self._end_blinking, (camera_id,))
        timer.daemon = True
        with self._blinking:
            before = self._timers.pop(camera_id, None)
            self._timers[camera_id] = timer
        if before is not None:
            before.cancel()
        timer.start()
        return f"{self._who(camera_id)}: the lamp blinks red and yellow for {self._identify_s:g} s"

    def expose(self, camera: str | int | None, auto: bool) -> str:
        """Let the colour camera adapt its exposure, or hold the one that it has found."""
        camera_id = self._camera_id(camera)
        self._control(camera_id, "auto_exposure", auto)
        return f"{self._who(camera_id)}: exposure {'adapts to the room' if auto else 'is held as it is'}"

    def start_recording(self, name: str | None = None) -> str:
        """Record to a new file in `[recording] folder`, by default named by date and time."""
        folder = self._rig.settings.recording.folder
        path = folder / (_take_name(name) if name else _dated_name(folder))
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigurationError(f"recording.folder {folder} cannot be made: {error.strerror}") from error
        self._rig.start_recording(path)
        return f"recording to {path}"

    def stop_recording(self) -> str:
        """End the recording."""
        status = self._rig.stop_recording()
        if status is None:
            raise RigError("nothing is being recorded")
        return recorded(status)

    def start_calibration(
        self, camera: str | None = None, coached: bool = False, frames: int | None = None
    ) -> str:
        """Begin to calibrate while the rig runs on; one camera alone where one is given."""
        self._session.start(camera, coached, frames)
        what = "the whole rig" if camera is None else f"camera {camera}"
        return (
            f"calibrating {what} on {counted(self._session.view.wanted, 'complete set')}: keep the room still"
        )

    def cancel_calibration(self) -> str:
        """Give up the calibration that runs."""
        self._session.cancel()
        return self._session.view.message or "no calibration is running"

    def accept_calibration(self) -> str:
        """Write the calibration that is ready and put it in force; takes some seconds."""
        self._session.accept()
        return self._session.view.message or ""

    def reject_calibration(self) -> str:
        """Forget the calibration that is ready."""
        self._session.reject()
        return self._session.view.message or ""

    def close(self) -> None:
        """End what still blinks."""
        with self._blinking:
            timers = dict(self._timers)
        for camera_id, timer in timers.items():
            timer.cancel()
            self._end_blinking(camera_id)

    def _end_blinking(self, camera_id: int | None) -> None:
        with self._blinking:
            self._timers.pop(camera_id, None)
        try:
            self._control(camera_id, "led", ORDINARY)
        except RigError as error:  # nobody waits for it any more
            logger.warning("a lamp may blink on: %s", error)

    def _control(self, camera_id: int | None, name: str, value: ControlValue) -> None:
        """RigError that names the cameras which did not, and why."""
        answers = self._rig.control(camera_id, name, value)
        if not answers:
            raise RigError(f"no camera is connected that could set {name}")
        names = self._names()
        troubles = [
            f"{names.get(i, i)}: {answer.text}"
            for i, answer in sorted(answers.items())
            if answer.outcome is not Outcome.DONE
        ]
        if troubles:
            told = f"{len(troubles)} of {counted(len(answers), 'camera')} did not set {name}: "
            raise RigError(told + "; ".join(troubles))

    def _camera_id(self, camera: str | int | None) -> int | None:
        return None if camera is None else find_camera_id(camera, self._names())

    def _who(self, camera_id: int | None) -> str:
        return "every camera" if camera_id is None else self._names().get(camera_id, str(camera_id))

    def _names(self) -> dict[int, str]:
        return {camera.camera_id: camera.name for camera in self._rig.status().cameras}


def _take_name(name: str) -> str:
    """A file's name without any folder, which whoever asks may not choose; ConfigurationError for another."""
    plain = name == Path(name).name and name.isprintable() and not name.startswith(".")
    if not plain or "\\" in name or len(name) > _MAX_NAME:
        raise ConfigurationError(
            f"{name!r} cannot name a take: write a plain file name of 100 characters at most"
        )
    stem = name.removesuffix(_SUFFIX)
    if _PART.search(stem):
        raise ConfigurationError(f"{name!r} would name a part of another take: end it otherwise")
    return stem + _SUFFIX


def _dated_name(folder: Path) -> str:
    """Date and time, in the time zone of the machine; counted on where two begin in one second."""
    stem = f"{datetime.now().astimezone():%Y-%m-%d_%H-%M-%S}"
    count = 1
    while (folder / (name := stem + (f"_{count}" if count > 1 else "") + _SUFFIX)).exists():
        count += 1
    return name
