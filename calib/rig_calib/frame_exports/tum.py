"""TUM RGB-D: one folder a camera, colour with depth registered to it, and the calibrated pose.

Format: "File Formats" of the RGB-D SLAM dataset (Sturm et al. 2012): depth in 1/5000 m, 0 = none; times in
seconds of Unix time; poses of the colour camera in the world, here the rig frame, quaternion (x, y, z, w).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from rig_calib.exports.rotations import quaternion_wxyz
from rig_calib.frame_exports.depth_images import has_depth, registered_depth_image
from rig_calib.frame_exports.job import Exported, ExportJob
from rig_calib.frame_exports.placed_cameras import (
    PlacedCamera,
    missing_notes,
    placed_cameras,
    unplaced_notes,
    views_by_id,
)
from rig_calib.frame_exports.time_stamps import TimeStamps
from rig_calib.offline.workers import Batch, batches_of
from rig_calib.whole_folder import whole_folder
from rig_protocol.frames import ImageU8, ImageU16

UNITS_PER_M = 5000.0
_BATCH = 4  # panoramic frames: some 30 MB of PNG files of twelve cameras


@dataclass(frozen=True, slots=True)
class _Pair:
    """PNG files of one camera at one instant; `depth` is None where it delivered none."""

    camera_id: int
    timestamp_ns: int
    color: bytes
    depth: bytes | None


@dataclass(slots=True)
class _Sequence:
    """What was written of one camera: when there is colour, and when depth."""

    camera: PlacedCamera
    folder: Path
    colors: list[str] = field(default_factory=list)
    depths: list[str] = field(default_factory=list)

    def write(self, pair: _Pair, stamps: TimeStamps) -> None:
        stamp = stamps.seconds(pair.timestamp_ns)
        (self.folder / "rgb" / f"{stamp}.png").write_bytes(pair.color)
        self.colors.append(stamp)
        if pair.depth is not None:
            (self.folder / "depth" / f"{stamp}.png").write_bytes(pair.depth)
            self.depths.append(stamp)

    def finish(self) -> None:
        """Write the lists, the pose and the intrinsics."""
        for name, lines in _text_files(self.camera, self.colors, self.depths).items():
            (self.folder / name).write_text("".join(f"{line}\n" for line in lines))


def export(job: ExportJob) -> Exported:
    """Write the folders; what is left out is in the notes."""
    cameras, stamps = placed_cameras(job), TimeStamps.of(job.capture)
    batches = batches_of(job.capture, job.positions, _BATCH)
    with whole_folder(job.out) as folder:
        sequences = {camera.id: _Sequence(camera, folder / camera.name) for camera in cameras}
        for sequence in sequences.values():
            for kind in ("rgb", "depth"):
                (sequence.folder / kind).mkdir(parents=True)
        for pairs in job.workers.map(partial(_pairs, cameras=cameras), batches, job.tell):
            for pair in pairs:
                sequences[pair.camera_id].write(pair, stamps)
        written = [len(sequence.colors) for sequence in sequences.values()]
        job.refuse_nothing(sum(written))
        for sequence in sequences.values():
            sequence.finish()
    missing = missing_notes([camera.name for camera in cameras], written, len(job.positions))
    return Exported((job.out,), (*unplaced_notes(job, cameras), *missing, *stamps.notes))


def _pairs(batch: Batch, cameras: Sequence[PlacedCamera]) -> list[_Pair]:
    pairs = []
    for panorama in batch.panoramas():
        views = views_by_id(batch.capture.description, panorama)
        for camera in cameras:
            view, frame = views.get(camera.id), panorama.frames.get(camera.id)
            if view is None or frame is None:
                continue
            color = view.color[0]
            depth = None
            if has_depth(view):
                depth = _png(registered_depth_image(view, camera.correction, UNITS_PER_M))
            pairs.append(_Pair(camera.id, frame.timestamp_ns, _png(_in_color(color)), depth))
    return pairs


def _text_files(camera: PlacedCamera, colors: list[str], depths: list[str]) -> dict[str, list[str]]:
    w, x, y, z = quaternion_wxyz(camera.T_rig_camera)
    pose = " ".join(repr(float(value)) for value in (*camera.T_rig_camera[:3, 3], x, y, z, w))
    color = camera.model.color
    lens = " ".join(map(repr, (color.fx, color.fy, color.cx, color.cy, *color.dist)))
    measured = set(depths)
    return {
        "rgb.txt": ["# color images", "# timestamp filename", *(f"{t} rgb/{t}.png" for t in colors)],
        "depth.txt": [
            "# depth maps, 5000 a metre, registered to the color images",
            "# timestamp filename",
            *(f"{t} depth/{t}.png" for t in depths),
        ],
        "associations.txt": [f"{t} rgb/{t}.png {t} depth/{t}.png" for t in colors if t in measured],
        "groundtruth.txt": [
            "# calibrated pose of the color camera in the rig frame; the rig is taken to stand still",
            "# timestamp tx ty tz qx qy qz qw",
            *(f"{t} {pose}" for t in colors),
        ],
        "intrinsics.txt": ["# color camera: fx fy cx cy d0 d1 d2 d3 d4 (k1 k2 p1 p2 k3)", lens],
    }


def _in_color(image: ImageU8) -> ImageU8:
    """A grey image in three equal channels: TUM's readers expect colour."""
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)


def _png(image: ImageU8 | ImageU16) -> bytes:
    return bytes(cv2.imencode(".png", image)[1])
