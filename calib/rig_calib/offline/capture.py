"""A capture on disk, rig folder or recording, whose panoramic frames can be read from any place on."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rig_calib.recorded_calibration import recorded_calibration
from rig_calib.recorded_panoramas import encoded_sets, is_recording
from rig_calib.rig_calibration import RigCalibration
from rig_calib.rig_folder_calibration import read_description
from rig_protocol.decoding import decode_frame
from rig_protocol.errors import ConfigurationError
from rig_protocol.frames import EncodedFrame, PanoramicFrame, RgbdFrame
from rig_protocol.recorded_sets import EncodedSet
from rig_protocol.recording import Recording
from rig_protocol.rig_folder import RigDescription, frame_indices, read_frame


@dataclass(frozen=True, slots=True)
class FrameMark:
    """A panoramic frame's index, and when its set went out in rig time; 0 in a rig folder."""

    index: int
    time_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """What is known of a capture without reading its images; small, and understood by other processes.

    `marks`: its panoramic frames, in order; a position is an index into them. `calibration`: the one that
    the recording carries.
    """

    path: Path
    description: RigDescription
    marks: tuple[FrameMark, ...]
    calibration: RigCalibration | None = None

    def read(self, positions: range) -> Iterator[PanoramicFrame]:
        """The panoramic frames there, complete or not, one by one; DataError where the file is damaged."""
        marks = [self.marks[position] for position in positions]
        if is_recording(self.path):
            yield from _recorded(self.path, marks)
            return
        for mark in marks:
            yield _of_folder(self.path, self.description, mark.index)


def open_capture(path: Path) -> Capture:
    """Look through a capture; ConfigurationError when there is none, or no panoramic frame in it."""
    description = read_description(path)
    calibration = None
    if is_recording(path):
        recording = Recording(path)
        marks = tuple(FrameMark(one.index, one.time_ns) for one in encoded_sets(recording))
        calibration = recorded_calibration(recording)
    else:
        held = (frame_indices(path, camera.name) for camera in description.cameras)
        marks = tuple(FrameMark(index, 0) for index in sorted({i for own in held for i in own}))
    if not marks:
        raise ConfigurationError(f"{path} holds no panoramic frames")
    return Capture(path, description, marks, calibration)


def _recorded(take: Path, marks: Sequence[FrameMark]) -> Iterator[PanoramicFrame]:
    wanted = {mark.index for mark in marks}
    for one in encoded_sets(Recording(take)):
        if one.index in wanted:
            yield _decoded(one)
        if one.index >= marks[-1].index:
            return


def _decoded(one: EncodedSet) -> PanoramicFrame:
    return PanoramicFrame.of(one.index, {camera_id: _frame(held) for camera_id, held in one.frames.items()})


def _frame(held: EncodedFrame | None) -> RgbdFrame | None:
    return None if held is None else decode_frame(held)


def _of_folder(folder: Path, description: RigDescription, index: int) -> PanoramicFrame:
    frames: dict[int, RgbdFrame | None] = {
        camera.id: read_frame(folder, camera, index) if index in frame_indices(folder, camera.name) else None
        for camera in description.cameras
    }
    return PanoramicFrame.of(index, frames)
