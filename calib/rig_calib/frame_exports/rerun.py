"""Rerun recording (.rrd): cameras, images, depth, cloud and panorama on three timelines.

Entities: rig/NAME (pose of the colour camera), rig/NAME/color, rig/NAME/depth (pose of the depth camera),
rig/NAME/depth/image, rig/cloud, panorama. Rerun's pinhole knows no distortion.
"""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun as rr

from rig_calib.frame_exports.frame_files import make_folder_of
from rig_calib.frame_exports.job import Exported, ExportJob
from rig_calib.frame_exports.placed_cameras import (
    PlacedCamera,
    missing_notes,
    placed_cameras,
    unplaced_notes,
)
from rig_calib.frame_exports.shown_frames import ShownCamera, ShownFrame, shown_frames
from rig_calib.frame_exports.time_stamps import TimeStamps
from rig_calib.whole_file import whole_path
from rig_calib.whole_folder import refuse_existing
from rig_protocol.camera import Intrinsics
from rig_protocol.errors import RigError
from rig_protocol.frames import DepthFrame
from rig_protocol.poses import Pose
from rig_protocol.troubleshooting import Topic

FRAME, RIG_TIME, UTC = "frame", "rig_time", "utc"
_APPLICATION = "kinect-rig"
_RIG = "rig"
_SPARE_BYTES = 100 << 20  # two panoramic frames of twelve cameras, and what others write meanwhile
_FLUSH_S = 20.0  # for ever, by default, where the writing thread has ended
_RING_AXES = rr.ViewCoordinates.FLU  # x through camera 0, z up


def export(job: ExportJob) -> Exported:
    """Write the file; what is left out is in the notes."""
    refuse_existing(job.out)
    make_folder_of(job.out)
    cameras, stamps = placed_cameras(job), TimeStamps.of(job.capture)
    written = dict.fromkeys((camera.id for camera in cameras), 0)
    with whole_path(job.out) as path, _opened(path, stamps) as log:
        if job.needed_calibration().rig_frame == "ring":
            log.recording.log(_RIG, _RING_AXES, static=True)
        for camera in cameras:
            log.pose([_RIG, camera.name], camera.T_rig_camera)
            log.lens([_RIG, camera.name, "color"], camera.model.color)
        for frame in shown_frames(job, cameras):
            for shown in frame.cameras:
                written[shown.camera_id] += 1
            log.frame(frame, cameras)
        job.refuse_nothing(sum(written.values()))
    names = [camera.name for camera in cameras]
    missing = missing_notes(names, list(written.values()), len(job.positions))
    return Exported((job.out,), (*unplaced_notes(job, cameras), *missing, *stamps.notes))


@contextmanager
def _opened(path: Path, stamps: TimeStamps) -> Iterator["_Log"]:
    """A log to this file; RigError where it cannot be written, which Rerun tells as a RuntimeError."""
    recording = rr.RecordingStream(_APPLICATION)
    try:
        recording.save(path)
        yield _Log(recording, path, stamps)
        recording.flush(timeout_sec=_FLUSH_S)
    except RuntimeError as error:  # no disconnect: it waits for ever for a file that cannot be written
        raise RigError(f"{path} could not be written: {error}", Topic.FULL_DISK) from error
    except BaseException:
        recording.disconnect()
        raise
    recording.disconnect()


def _refuse_full_disk(path: Path) -> None:
    """Before Rerun meets it: its SDK (0.41) never returns from a disk that filled up under it."""
    if shutil.disk_usage(path.parent).free < _SPARE_BYTES:
        raise RigError(f"{path} could not be written: the disk is nearly full", Topic.FULL_DISK)


class _Log:
    """What is logged, on its way to the file: never more than a panoramic frame is held."""

    def __init__(self, recording: rr.RecordingStream, path: Path, stamps: TimeStamps) -> None:
        self.recording, self._path = recording, path
        rr.set_log_time_enabled(False, self.recording)
        rr.set_log_tick_enabled(False, self.recording)
        self._stamps = stamps
        self._depth_lenses: set[int] = set()

    def pose(self, place: list[object], T_parent_child: Pose) -> None:
        transform = rr.Transform3D(translation=T_parent_child[:3, 3], mat3x3=T_parent_child[:3, :3])
        self.recording.log(place, transform, static=True)

    def lens(self, place: list[object], lens: Intrinsics) -> None:
        K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
        pinhole = rr.Pinhole(
            image_from_camera=K,
            resolution=[lens.width, lens.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.2,
        )
        self.recording.log(place, pinhole, static=True)

    def frame(self, frame: ShownFrame, cameras: Sequence[PlacedCamera]) -> None:
        """One panoramic frame: images at their exposures, the rest at its mean; RigError on a full disk."""
        _refuse_full_disk(self._path)
        by_id = {camera.id: camera for camera in cameras}
        self.recording.set_time(FRAME, sequence=frame.index)
        for shown in frame.cameras:
            self._set_time(shown.timestamp_ns)
            self._camera(by_id[shown.camera_id], shown)
        self._set_time(frame.timestamp_ns)
        self.recording.log([_RIG, "cloud"], rr.Points3D(frame.points_m, colors=frame.colors))
        panorama = rr.EncodedImage(contents=frame.panorama_jpeg, media_type="image/jpeg")
        self.recording.log("panorama", panorama)
        self.recording.flush(timeout_sec=_FLUSH_S)

    def _camera(self, camera: PlacedCamera, shown: ShownCamera) -> None:
        color = rr.EncodedImage(contents=shown.color_jpeg, media_type="image/jpeg")
        self.recording.log([_RIG, camera.name, "color"], color)
        if shown.depth_mm is not None:
            self._depth_lens(camera, shown.depth_frame)
            depth = rr.DepthImage(shown.depth_mm, meter=1000.0)
            self.recording.log([_RIG, camera.name, "depth", "image"], depth)

    def _depth_lens(self, camera: PlacedCamera, depth_frame: DepthFrame) -> None:
        """Once, when the first image tells whose pixels it has."""
        if camera.id not in self._depth_lenses:
            self._depth_lenses.add(camera.id)
            grid = camera.grid(depth_frame)
            self.pose([_RIG, camera.name, "depth"], grid.T_color_grid)
            self.lens([_RIG, camera.name, "depth", "image"], grid.intrinsics)

    def _set_time(self, rig_time_ns: int) -> None:
        self.recording.set_time(RIG_TIME, duration=np.timedelta64(rig_time_ns, "ns"))
        if self._stamps.utc_minus_rig_ns is not None:
            utc = np.datetime64(self._stamps.ns(rig_time_ns), "ns")
            self.recording.set_time(UTC, timestamp=utc)
