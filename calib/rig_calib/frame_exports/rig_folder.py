"""A rig folder of a recording: images as the sensor gave them, for `rig-calib solve` and other programs.

Damaged frames stay out: a folder cannot say of one that it is.
"""

from dataclasses import dataclass

from rig_calib.frame_exports.job import Exported, ExportJob
from rig_calib.frame_exports.placed_cameras import missing_notes
from rig_calib.offline.workers import Batch, batches_of
from rig_calib.whole_folder import whole_folder
from rig_protocol.frames import RgbdFrame
from rig_protocol.gravity import Gravity
from rig_protocol.rig_folder import encoded_images, with_gravity, write_rig_description

_BATCH = 4  # panoramic frames: some 30 MB of PNG files of twelve cameras


@dataclass(frozen=True, slots=True)
class _Files:
    """PNG files of one camera at one instant by name, and down as it felt it."""

    camera_id: int
    images: dict[str, bytes]
    gravity: Gravity | None


def export(job: ExportJob) -> Exported:
    """Write the folder; how many frames are left out is in the notes."""
    description = job.capture.description
    felt: dict[int, list[Gravity]] = {}
    written = dict.fromkeys(description.camera_ids, 0)
    with whole_folder(job.out) as folder:
        for camera in description.cameras:
            (folder / camera.name).mkdir()
        batches = batches_of(job.capture, job.positions, _BATCH)
        for batch in job.workers.map(_files, batches, job.tell):
            for files in batch:
                written[files.camera_id] += 1
                if files.gravity is not None:
                    felt.setdefault(files.camera_id, []).append(files.gravity)
                directory = folder / description.camera(files.camera_id).name
                for name, data in files.images.items():
                    (directory / name).write_bytes(data)
        job.refuse_nothing(sum(written.values()))
        write_rig_description(folder, with_gravity(description, felt))
    names = [camera.name for camera in description.cameras]
    return Exported((job.out,), tuple(missing_notes(names, list(written.values()), len(job.positions))))


def _files(batch: Batch) -> list[_Files]:
    cameras = set(batch.capture.description.camera_ids)
    return [
        _Files(frame.camera_id, encoded_images(frame, panorama.index), frame.gravity)
        for panorama in batch.panoramas()
        for frame in panorama.frames.values()
        if frame is not None and frame.camera_id in cameras and _usable(frame)
    ]


def _usable(frame: RgbdFrame) -> bool:
    """Whether a folder can hold it: its readers look for colour first."""
    return not frame.damaged and (frame.color is not None or frame.bayer is not None)
