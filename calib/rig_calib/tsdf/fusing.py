"""A capture to one volume: batches of frames, each averaged, integrated by any number of workers."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from rig_calib.fusion.gains import Gain
from rig_calib.fusion.voxels import Keys
from rig_calib.offline.capture import Capture
from rig_calib.offline.workers import Batch, Tell, Workers, batches_of
from rig_calib.rig_calibration import RigCalibration
from rig_calib.tsdf.range_image import RangeImage, range_images
from rig_calib.tsdf.volume import MAX_FRAMES, MAX_VOXEL_M, MIN_VOXEL_M, Volume, blocks_near, check_size
from rig_calib.view import CameraView, views_from_panoramas
from rig_protocol.errors import ConfigurationError, DataError

FRAMES_A_BATCH = 10
"""Averaged before they are cleaned: what flickers shows."""


def fuse_capture(
    capture: Capture,
    calibration: RigCalibration,
    gains: Mapping[int, Gain],
    voxel_m: float,
    workers: Workers,
    tell: Tell = lambda _share: None,
) -> Volume:
    """What the cameras measured in all frames of a capture, of a scene that was still.

    Where there is more than one batch, a first pass over them finds the blocks, so that every image speaks
    of all that it sees through, whenever it was taken. DataError when no camera measured anything,
    ConfigurationError for a voxel that is too small for this scene.
    """
    _check(voxel_m, len(capture.marks))
    batches = batches_of(capture, range(len(capture.marks)), FRAMES_A_BATCH)
    keys, first = None, 0.0
    if len(batches) > 1:
        first, keys = 0.5, np.empty(0, np.int64)
        for found in workers.map(
            partial(_blocks, calibration, voxel_m), batches, lambda share: tell(share / 2)
        ):
            keys = np.union1d(keys, found)
            check_size(len(keys), voxel_m)
    total: Volume | None = None
    work = partial(_volume, calibration, dict(gains), voxel_m, keys)
    for volume in workers.map(work, batches, lambda share: tell(first + (1 - first) * share)):
        if total is None:
            total = volume
        else:
            total.take(volume)
    return _not_empty(total)


def fuse_volume(
    views: Sequence[CameraView], calibration: RigCalibration, gains: Mapping[int, Gain], voxel_m: float
) -> Volume:
    """The same of views in memory: one batch. Errors as `fuse_capture`."""
    _check(voxel_m, max((len(view.color) for view in views), default=0))
    images, _ = range_images(views, calibration, gains)
    return _not_empty(_integrated(images, voxel_m, None))


def _check(voxel_m: float, frames: int) -> None:
    if not MIN_VOXEL_M <= voxel_m <= MAX_VOXEL_M:
        raise ConfigurationError(
            f"a voxel of {1e3 * voxel_m:g} mm: take {1e3 * MIN_VOXEL_M:g} to {1e3 * MAX_VOXEL_M:g} mm"
        )
    if frames > MAX_FRAMES:
        raise ConfigurationError(f"{frames} frames are too many for one surface: take at most {MAX_FRAMES}")


def _not_empty(volume: Volume | None) -> Volume:
    if volume is None or not volume.sums.weight.any():
        raise DataError("no camera that has a pose in the calibration delivered depth: there is no surface")
    return volume


def _images(batch: Batch, calibration: RigCalibration, gains: Mapping[int, Gain]) -> list[RangeImage]:
    views = views_from_panoramas(batch.capture.description, list(batch.panoramas()))
    return range_images(views, calibration, gains)[0]


def _blocks(calibration: RigCalibration, voxel_m: float, batch: Batch) -> Keys:
    return blocks_near(_images(batch, calibration, {}), voxel_m)


def _volume(
    calibration: RigCalibration, gains: Mapping[int, Gain], voxel_m: float, keys: Keys | None, batch: Batch
) -> Volume:
    return _integrated(_images(batch, calibration, gains), voxel_m, keys)


def _integrated(images: Sequence[RangeImage], voxel_m: float, keys: Keys | None) -> Volume:
    volume = Volume.at(blocks_near(images, voxel_m) if keys is None else keys, voxel_m)
    volume.add(images)
    return volume
