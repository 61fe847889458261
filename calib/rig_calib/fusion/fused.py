"""FusedRig: cloud and panorama of one calibrated capture, made from the same cleaned surfaces."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rig_calib.fusion.cloud import PointCloud
from rig_calib.fusion.gains import Gain, color_gains
from rig_calib.fusion.panorama import DEFAULT_CIRCLE_PX, Panorama, render_surfaces
from rig_calib.fusion.point_cloud import DEFAULT_VOXEL_M, fuse_surfaces
from rig_calib.fusion.surface import Surface, camera_surfaces
from rig_calib.rig_calibration import RigCalibration
from rig_calib.view import CameraView


@dataclass(frozen=True, slots=True, eq=False)
class FusedRig:
    """Everything that fusion makes of one capture; `panorama` is None when no camera can contribute."""

    surfaces: tuple[Surface, ...]
    gains: Mapping[int, Gain]
    cloud: PointCloud
    panorama: Panorama | None


def fuse_rig(
    views: Sequence[CameraView],
    calibration: RigCalibration,
    frame: int | None = None,
    voxel_m: float = DEFAULT_VOXEL_M,
    circle_px: int = DEFAULT_CIRCLE_PX,
) -> FusedRig:
    """Cloud and panorama in the time that either takes alone plus its own drawing.

    `frame` picks one panoramic frame, None averages them all. Cameras that could not take part are
    named in the `skipped` of cloud and panorama.
    """
    surfaces, skipped = camera_surfaces(views, calibration, frame)
    gains = color_gains(surfaces, calibration.poses)
    cloud = fuse_surfaces(surfaces, calibration.poses, voxel_m, gains, skipped)
    panorama = None
    if len(cloud):
        panorama = render_surfaces(surfaces, views, calibration, gains, frame, circle_px, skipped)
    return FusedRig(tuple(surfaces), gains, cloud, panorama)
