"""Panoramic frames as viewers are given them: JPEG colour, depth in millimetres, thinned cloud, panorama."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.frame_exports.depth_images import depth_image, has_depth
from rig_calib.frame_exports.fused_batches import fused_batch, settings_of
from rig_calib.frame_exports.job import ExportJob
from rig_calib.frame_exports.placed_cameras import PlacedCamera, views_by_id
from rig_calib.fusion.live import FusedFrame, LiveFusionSettings
from rig_calib.fusion.voxels import voxel_keys
from rig_calib.offline.workers import Batch, batches_of
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.frames import DepthFrame, ImageU8, ImageU16, PanoramicFrame
from rig_protocol.rig_folder import RigDescription

JPEG = (
    cv2.IMWRITE_JPEG_QUALITY,
    95,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
)
"""Viewers must decode twelve streams at once; who needs every bit takes TUM's folders or a rig folder."""

CLOUD_VOXEL_M = 0.02
"""Points that a viewer can turn: one of each cube; PLY, PCD, E57 and LAS hold them all."""

_BATCH = 2  # panoramic frames: some 25 MB of twelve cameras


@dataclass(frozen=True, slots=True, eq=False)
class ShownCamera:
    """One camera at one instant, rig time; `depth_mm` (H,W) on the grid of `depth_frame`, 0 = none."""

    camera_id: int
    timestamp_ns: int
    color_jpeg: bytes
    depth_mm: ImageU16 | None
    depth_frame: DepthFrame


@dataclass(frozen=True, slots=True, eq=False)
class ShownFrame:
    """One panoramic frame: `points_m` (N,3) f32 in the rig frame, `colors` (N,3) u8 RGB."""

    index: int
    timestamp_ns: int
    cameras: tuple[ShownCamera, ...]
    points_m: npt.NDArray[np.float32]
    colors: ImageU8
    panorama_jpeg: bytes


def shown_frames(job: ExportJob, cameras: Sequence[PlacedCamera]) -> Iterator[ShownFrame]:
    """Every panoramic frame of the job in its order, made by its workers, a few held at a time."""
    calibration, settings = job.needed_calibration(), settings_of(job)
    work = partial(_shown_batch, cameras=cameras, calibration=calibration, settings=settings)
    batches = batches_of(job.capture, job.positions, _BATCH)
    for frames in job.workers.map(work, batches, job.tell):
        yield from frames


def _shown_batch(
    batch: Batch,
    cameras: Sequence[PlacedCamera],
    calibration: RigCalibration,
    settings: LiveFusionSettings,
) -> list[ShownFrame]:
    description = batch.capture.description
    return [
        _shown_frame(description, cameras, panorama, fused)
        for panorama, fused in fused_batch(batch, calibration, settings)
    ]


def _shown_frame(
    description: RigDescription, cameras: Sequence[PlacedCamera], panorama: PanoramicFrame, fused: FusedFrame
) -> ShownFrame:
    _, kept = np.unique(voxel_keys(fused.points_m.astype(np.float64), CLOUD_VOXEL_M), return_index=True)
    return ShownFrame(
        index=panorama.index,
        timestamp_ns=panorama.timestamp_ns,
        cameras=tuple(_shown_cameras(description, cameras, panorama)),
        points_m=fused.points_m[kept],
        colors=fused.colors[kept],
        panorama_jpeg=_jpeg(fused.panorama),
    )


def _shown_cameras(
    description: RigDescription, cameras: Sequence[PlacedCamera], panorama: PanoramicFrame
) -> Iterator[ShownCamera]:
    views = views_by_id(description, panorama)
    for camera in cameras:
        view, frame = views.get(camera.id), panorama.frames.get(camera.id)
        if view is None or frame is None:
            continue
        depth_mm = depth_image(view, camera.correction, 1e3) if has_depth(view) else None
        yield ShownCamera(camera.id, frame.timestamp_ns, _jpeg(view.color[0]), depth_mm, view.depth_frame)


def _jpeg(image: ImageU8) -> bytes:
    return bytes(cv2.imencode(".jpg", image, JPEG)[1])
