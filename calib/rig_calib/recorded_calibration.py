"""The calibration that a recording carries: the one in force when it ended."""

from pathlib import Path

from rig_calib.recorded_panoramas import is_recording
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.recording import CALIBRATION, Recording


def recorded_calibration(recording: Recording) -> RigCalibration | None:
    """None where it carries none; DataError where that is malformed, or of another schema."""
    if CALIBRATION not in recording.attachments:
        return None
    try:
        return RigCalibration.from_dict(recording.document(CALIBRATION))
    except DataError as error:
        raise DataError(f"{recording.path}: {CALIBRATION}: {error}") from error


def calibration_for(capture: Path, file: Path | None) -> RigCalibration:
    """The calibration in `file`, else that which the capture carries.

    ConfigurationError where there is neither, DataError for a malformed one.
    """
    if file is not None:
        return RigCalibration.load(file)
    found = recorded_calibration(Recording(capture)) if is_recording(capture) else None
    if found is None:
        raise ConfigurationError(f"{capture} carries no calibration: name it with --calibration FILE")
    return found
