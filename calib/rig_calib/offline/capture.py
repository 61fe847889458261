"""A capture on disk, rig folder or recording, whose panoramic frames can be read from any place on."""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rig_calib.recorded_calibration import recorded_calibration
from rig_calib.recorded_panoramas import is_recording
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.decoding import decode_frame
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import EncodedFrame, PanoramicFrame, RgbdFrame
from rig_protocol.recorded_hellos import recorded_hellos
from rig_protocol.recorded_sets import synchroniser_of, with_frames, with_sets
from rig_protocol.recording import HELLOS, Recording
from rig_protocol.recording_format import Entry, RecordedSet, time_of
from rig_protocol.rig_folder import RigDescription, frame_indices, read_frame, read_rig_description

logger = logging.getLogger(__name__)

# A frame came after its exposure, as far as the clocks agree.
_CLOCKS_APART_NS = 100_000_000


@dataclass(frozen=True, slots=True)
class FrameMark:
    """A panoramic frame's index, and when its set went out in rig time; 0 in a rig folder.

    `from_ns`: rig time from which on its images stand in the recording.
    """

    index: int
    time_ns: int
    from_ns: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """What is known of a capture without reading its images; small, and understood by other processes.

    `marks`: its panoramic frames, in order; a position is an index into them. `calibration`: the one that
    the recording carries. `grouped`: the sets of a recording that has none (an agent's), as the synchroniser
    makes them.
    """

    path: Path
    description: RigDescription
    marks: tuple[FrameMark, ...]
    calibration: RigCalibration | None = None
    recording: Recording | None = None
    grouped: tuple[RecordedSet, ...] = ()

    def only(self, indices: Iterable[int]) -> "Capture":
        """The same, of which nothing but the panoramic frames with these indices is known."""
        wanted = set(indices)
        return replace(self, marks=tuple(mark for mark in self.marks if mark.index in wanted))

    def read(self, positions: range) -> Iterator[PanoramicFrame]:
        """The panoramic frames there, complete or not, one by one; one without any image is left out.

        Of a recording only the chunks are read in which these frames may be. A frame of a recording that
        does not decode is missing from its set. DataError where the file is damaged.
        """
        marks = [self.marks[position] for position in positions]
        if not marks:
            return
        if is_recording(self.path):
            yield from _recorded(self.recording or Recording(self.path), self.grouped, marks)
        else:
            yield from _of_folder(self.path, self.description, marks)


def open_capture(path: Path) -> Capture:
    """Look through a capture; ConfigurationError when there is none, or no panoramic frame in it."""
    path = path.absolute()  # other processes may stand elsewhere
    return _open_recording(path) if is_recording(path) else _open_folder(path)


def _open_recording(path: Path) -> Capture:
    recording = Recording(path)
    sets = tuple(recording.sets())
    grouped = () if sets else _grouped(recording)
    marks = tuple(mark for one in sets or grouped if (mark := _mark(one)) is not None)
    if not marks:
        raise ConfigurationError(f"{path} holds no panoramic frames")
    return Capture(path, recording.description, marks, recorded_calibration(recording), recording, grouped)


def _grouped(recording: Recording) -> tuple[RecordedSet, ...]:
    """All is read for it, once."""
    hellos = recorded_hellos(recording.document(HELLOS), recording.description)
    entries = with_sets(recording.entries(), synchroniser_of(hellos))
    return tuple(entry for entry in entries if isinstance(entry, RecordedSet))


def _open_folder(path: Path) -> Capture:
    description = read_rig_description(path)
    indices = {index for camera in description.cameras for index in frame_indices(path, camera.name)}
    if not indices:
        raise ConfigurationError(f"{path} holds no panoramic frames")
    return Capture(path, description, tuple(FrameMark(index, 0) for index in sorted(indices)))


def _mark(one: RecordedSet) -> FrameMark | None:
    exposed_ns = [time_ns for time_ns in one.timestamps_ns.values() if time_ns is not None]
    if not exposed_ns:
        return None
    return FrameMark(one.index, one.taken_ns, max(0, min(exposed_ns) - _CLOCKS_APART_NS))


def _recorded(
    recording: Recording, grouped: Sequence[RecordedSet], marks: Sequence[FrameMark]
) -> Iterator[PanoramicFrame]:
    wanted, last = {(mark.time_ns, mark.index) for mark in marks}, (marks[-1].time_ns, marks[-1].index)
    entries = recording.entries(min(mark.from_ns for mark in marks))
    for one in with_frames(_with(grouped, entries) if grouped else entries):
        place = (one.time_ns, one.index)
        if place in wanted:
            frames = {camera_id: _decoded(frame) for camera_id, frame in one.frames.items()}
            if any(frames.values()):
                yield PanoramicFrame.of(one.index, frames)
        if place >= last:
            return


def _with(grouped: Iterable[RecordedSet], entries: Iterable[Entry]) -> Iterator[Entry]:
    """The entries, and every set behind what had come when it was made."""
    sets = iter(grouped)
    coming = next(sets, None)
    for entry in entries:
        while coming is not None and coming.taken_ns < time_of(entry):
            yield coming
            coming = next(sets, None)
        yield entry
    if coming is not None:
        yield coming
        yield from sets


def _decoded(frame: EncodedFrame | None) -> RgbdFrame | None:
    if frame is None:
        return None
    try:
        return decode_frame(frame)
    except DataError as error:
        logger.warning("camera %d, frame %d is left out: %s", frame.camera_id, frame.sequence, error)
        return None


def _of_folder(
    folder: Path, description: RigDescription, marks: Sequence[FrameMark]
) -> Iterator[PanoramicFrame]:
    held: Mapping[int, set[int]] = {
        camera.id: set(frame_indices(folder, camera.name)) for camera in description.cameras
    }
    for mark in marks:
        frames = {
            camera.id: read_frame(folder, camera, mark.index) if mark.index in held[camera.id] else None
            for camera in description.cameras
        }
        yield PanoramicFrame.of(mark.index, frames)
