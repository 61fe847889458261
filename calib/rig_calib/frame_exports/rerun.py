"""Rerun recording (.rrd): cameras, images, depth, cloud and panorama on three timelines.

Entities: rig/NAME (pose of the colour camera), rig/NAME/color, rig/NAME/depth (pose of the depth camera),
rig/NAME/depth/image, rig/cloud, panorama. Rerun's pinhole knows no distortion.
"""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import rerun as rr

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
from rig_protocol.frames import DepthFrame
from rig_protocol.poses import Pose

FRAME, RIG_TIME, UTC = "frame", "rig_time", "utc"
_APPLICATION = "kinect-rig"
_RIG = "rig"
_RING_AXES = rr.ViewCoordinates.FLU  # x through camera 0, z up


def export(job: ExportJob) -> Exported:
    """Write the file; what is left out is in the notes."""
    refuse_existing(job.out)
    cameras, stamps = placed_cameras(job), TimeStamps.of(job.capture)
    written = dict.fromkeys((camera.id for camera in cameras), 0)
    with whole_path(job.out) as path, closing(_Log(path, stamps)) as log:
        if job.needed_calibration().rig_frame == "ring":
            log.recording.log(_RIG, _RING_AXES, static=True)
        for camera in cameras:
            log.pose([_RIG, camera.name], camera.T_rig_camera)
            log.lens([_RIG, camera.name, "color"], camera.model.color)
        for frame in shown_frames(job, cameras):
            for shown in frame.cameras:
                written[shown.camera_id] += 1
            log.frame(frame, cameras)
    names = [camera.name for camera in cameras]
    missing = missing_notes(names, list(written.values()), len(job.positions))
    return Exported((job.out,), (*unplaced_notes(job, cameras), *missing, *stamps.notes))


class _Log:
    """What is logged, on its way to the file: never more than a panoramic frame is held."""

    def __init__(self, path: Path, stamps: TimeStamps) -> None:
        self.recording = rr.RecordingStream(_APPLICATION)
        self.recording.save(path)
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
        """One panoramic frame: its images at their exposures, the rest at its mean."""
        by_id = {camera.id: camera for camera in cameras}
        self.recording.set_time(FRAME, sequence=frame.index)
        for shown in frame.cameras:
            self._set_time(shown.timestamp_ns)
            self._camera(by_id[shown.camera_id], shown)
        self._set_time(frame.timestamp_ns)
        self.recording.log([_RIG, "cloud"], rr.Points3D(frame.points_m, colors=frame.colors))
        panorama = rr.EncodedImage(contents=frame.panorama_jpeg, media_type="image/jpeg")
        self.recording.log("panorama", panorama)
        self.recording.flush()

    def close(self) -> None:
        """End the file."""
        self.recording.flush()
        self.recording.disconnect()

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
