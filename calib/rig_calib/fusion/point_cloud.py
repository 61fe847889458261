"""One coloured point cloud of all cameras: inverse-variance averages of what falls into a voxel."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from rig_calib.fusion.cloud import PointCloud
from rig_calib.fusion.gains import NO_GAIN, Gain, color_gains
from rig_calib.fusion.surface import Surface, camera_surfaces
from rig_calib.fusion.voxels import Array, Keys, sum_by_key, voxel_keys
from rig_calib.rig_calibration import RigCalibration
from rig_calib.view import CameraView
from rig_protocol.poses import Pose

DEFAULT_VOXEL_M = 0.01
_COLUMNS = 7  # weight, then weighted x, y, z and weighted red, green, blue


def fuse_point_cloud(
    views: Sequence[CameraView],
    calibration: RigCalibration,
    frame: int | None = None,
    voxel_m: float = DEFAULT_VOXEL_M,
    equalise_colors: bool = True,
) -> PointCloud:
    """All cameras' points in the rig frame, one a voxel; cameras without pose or depth are in `skipped`.

    `frame` picks one panoramic frame, None averages them all. `equalise_colors` takes out what the
    cameras' exposures and white balances differ by in their overlaps.
    """
    surfaces, skipped = camera_surfaces(views, calibration, frame)
    gains = color_gains(surfaces, calibration.poses) if equalise_colors else {}
    return fuse_surfaces(surfaces, calibration.poses, voxel_m, gains, skipped)


def fuse_surfaces(
    surfaces: Iterable[Surface],
    poses: Mapping[int, Pose],
    voxel_m: float = DEFAULT_VOXEL_M,
    gains: Mapping[int, Gain] | None = None,
    skipped: tuple[str, ...] = (),
) -> PointCloud:
    """The surfaces at their poses T_rig_camera, averaged in voxels of `voxel_m` by inverse variance.

    Each camera is reduced to voxels before the next is looked at: memory is bounded by the result and
    one camera. ValueError for a voxel below a millimetre.
    """
    keys, sums = np.empty(0, np.int64), np.empty((0, _COLUMNS))
    for surface in surfaces:
        gain = (gains or {}).get(surface.camera_id, NO_GAIN)
        own_keys, own_sums = _camera_sums(surface, poses[surface.camera_id], gain, voxel_m)
        keys, sums = sum_by_key(np.concatenate([keys, own_keys]), np.concatenate([sums, own_sums]))
    means = sums[:, 1:] / sums[:, :1]
    colors = np.clip(np.rint(means[:, 3:]), 0, 255).astype(np.uint8)
    return PointCloud(means[:, :3].astype(np.float32), colors, skipped)


def _camera_sums(surface: Surface, T_rig_camera: Pose, gain: Gain, voxel_m: float) -> tuple[Keys, Array]:
    points = surface.points_at(T_rig_camera)
    weight = 1.0 / np.square(surface.sigma_m.astype(np.float64))
    values = np.column_stack([np.ones_like(weight), points, surface.colors * gain])
    return sum_by_key(voxel_keys(points, voxel_m), values * weight[:, None])
