"""A capture calibrated, rig folder or recording: from files to a result that remembers where it came from."""

import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path

from rig_calib.calibration import CalibrationResult, calibrate
from rig_calib.provenance import with_provenance, with_recalibration
from rig_calib.recalibration import find_camera, recalibrate
from rig_calib.recorded_panoramas import is_recording, recorded_panoramas
from rig_calib.rig_calibration import RigCalibration
from rig_calib.settings import CalibrationSettings
from rig_calib.stages import Progress
from rig_calib.view import CameraView, views_from_panoramas
from rig_protocol.errors import ConfigurationError
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.recording import Recording
from rig_protocol.rig_folder import RigDescription, frame_indices, read_frame, read_rig_description

MAX_FRAMES = 100  # more average nothing away that a hundred have not, and fill the memory


def solve_folder(
    folder: Path, settings: CalibrationSettings, frames: int | None = None, progress: Progress | None = None
) -> tuple[CalibrationResult, list[CameraView]]:
    """Calibrate on the first `frames` panoramic frames of a folder (default: all, at most 100).

    Of a recording they are the complete ones (default: 5).
    ConfigurationError when the folder is none of a rig or holds fewer frames, DataError for a torn file.
    """
    started_s = time.perf_counter()
    description = read_description(folder)
    views = read_views(folder, description, frames)
    load_s = time.perf_counter() - started_s
    result = calibrate(views, description.ring, settings, progress)
    calibration = with_provenance(
        _with_load(result.calibration, load_s), source_of(folder), 0, settings.model_dump(mode="json")
    )
    return dataclasses.replace(result, calibration=calibration), views


def recalibrate_folder(
    folder: Path,
    known: RigCalibration,
    camera: str,
    settings: CalibrationSettings,
    frames: int | None = None,
    progress: Progress | None = None,
) -> tuple[CalibrationResult, list[CameraView]]:
    """Find one camera (its name or id) of a known calibration anew on frames of a folder.

    Errors as `solve_folder`; ConfigurationError for a camera that is not there, too.
    """
    started_s = time.perf_counter()
    description = read_description(folder)
    camera_id = find_camera(camera, known, {entry.id: entry.name for entry in description.cameras})
    views = read_views(folder, description, frames)
    load_s = time.perf_counter() - started_s
    result = recalibrate(views, known, camera_id, description.ring, settings, progress)
    found = _with_load(result.calibration, load_s)
    used = max(len(view.color) for view in views)
    calibration = with_recalibration(
        found, known, camera_id, used, source=source_of(folder), settings=settings.model_dump(mode="json")
    )
    return dataclasses.replace(result, calibration=calibration), views


def read_description(capture: Path) -> RigDescription:
    """What is known of the rig of a capture before calibration."""
    return Recording(capture).description if is_recording(capture) else read_rig_description(capture)


def source_of(capture: Path) -> str:
    """What the provenance calls it."""
    return "recording" if is_recording(capture) else "folder"


def _with_load(calibration: RigCalibration, load_s: float) -> RigCalibration:
    seconds = calibration.seconds
    return dataclasses.replace(
        calibration, seconds={**seconds, "load": load_s, "total": seconds["total"] + load_s}
    )


def read_views(folder: Path, description: RigDescription, frames: int | None = None) -> list[CameraView]:
    """Views of every camera of the folder; a camera may lack frames that others have."""
    return views_from_panoramas(description, list(read_panoramas(folder, description, frames)))


def read_panoramas(
    folder: Path, description: RigDescription, frames: int | None = None
) -> Iterator[PanoramicFrame]:
    """The first `frames` panoramic frames of the folder (default: all, at most 100), read one by one.

    Of a recording they are the complete ones (default: 5).
    """
    if is_recording(folder):
        yield from recorded_panoramas(folder, frames)
        return
    held = {camera.id: frame_indices(folder, camera.name) for camera in description.cameras}
    indices = sorted({index for own in held.values() for index in own})
    if not indices or (frames is not None and frames > len(indices)):
        wanted = "one" if frames is None else frames
        raise ConfigurationError(f"{folder} holds {len(indices)} panoramic frames, {wanted} asked for")
    for index in indices[: frames or MAX_FRAMES]:
        found: dict[int, RgbdFrame | None] = {
            camera.id: read_frame(folder, camera, index)
            for camera in description.cameras
            if index in held[camera.id]
        }
        yield PanoramicFrame.of(index, found)
