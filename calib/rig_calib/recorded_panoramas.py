"""The panoramic frames of a recording, as the offline programs take them."""

from collections.abc import Iterator
from pathlib import Path

from rig_protocol.decoding import decode_frame
from rig_protocol.errors import ConfigurationError
from rig_protocol.frames import EncodedFrame, PanoramicFrame
from rig_protocol.recorded_hellos import recorded_hellos
from rig_protocol.recorded_sets import EncodedSet, synchroniser_of, with_frames, with_sets
from rig_protocol.recording import HELLOS, Recording

DEFAULT_FRAMES = 5
"""Where nobody says how many: as many as `rig-server --calibrate` takes."""


def is_recording(capture: Path) -> bool:
    """Whether a path means a recording, not a rig folder."""
    return capture.suffix == ".mcap" and not capture.is_dir()


def encoded_sets(recording: Recording) -> Iterator[EncodedSet]:
    """The sets that went out; those that the synchroniser makes now where a take has none (an agent's)."""
    entries = recording.entries()
    if not recording.has_sets:
        hellos = recorded_hellos(recording.document(HELLOS), recording.description)
        entries = with_sets(entries, synchroniser_of(hellos))
    return with_frames(entries)


def recorded_panoramas(take: Path, frames: int | None = None) -> Iterator[PanoramicFrame]:
    """The first `frames` sets (default: 5) that hold an undamaged frame of every camera, read one by one.

    ConfigurationError when there are fewer, DataError for what is no recording or damaged.
    """
    recording = Recording(take)
    cameras, found, wanted = recording.description.camera_ids, 0, frames or DEFAULT_FRAMES
    for one in encoded_sets(recording):
        held = [frame for camera_id in cameras if (frame := _whole(one, camera_id)) is not None]
        if len(held) == len(cameras):
            found += 1
            yield PanoramicFrame.of(one.index, {frame.camera_id: decode_frame(frame) for frame in held})
        if found == wanted:
            return
    if not found or (frames is not None and found < frames):
        raise ConfigurationError(
            f"{take} holds {found} sets with an undamaged frame of every camera, {frames or 'one'} asked for"
        )


def _whole(one: EncodedSet, camera_id: int) -> EncodedFrame | None:
    frame = one.frames.get(camera_id)
    return None if frame is None or frame.damaged else frame
