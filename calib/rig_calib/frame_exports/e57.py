"""Clouds as E57 files (ASTM E2807): a scan a camera, from where it was taken.

Points are in the frame of their own depth camera, and the scan's pose places it in the rig frame: programs
then know the line of sight of every point, for normals, visibility and surfaces, and can hide a camera.
"""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pye57

from rig_calib.exports.rotations import quaternion_wxyz
from rig_calib.frame_exports.frame_files import Scene, export_scenes
from rig_calib.frame_exports.gps_time import gps_seconds
from rig_calib.frame_exports.job import Exported, ExportJob
from rig_calib.whole_file import whole_path
from rig_protocol.errors import RigError
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose, Vector, inverse, transform_points
from rig_protocol.troubleshooting import Topic


def export(job: ExportJob) -> Exported:
    """A file a panoramic frame."""
    return export_scenes(job, "cloud", ".e57", _write)


def _write(path: Path, scene: Scene) -> None:
    with whole_path(path) as part:
        e57 = None
        try:
            e57 = pye57.E57(str(part), "w")
            _write_scans(e57, scene)
            e57.close()
        except pye57.libe57.E57Exception as error:
            if e57 is not None:
                e57.image_file.cancel()
            raise RigError(f"{path} could not be written: {_reason(error)}", Topic.FULL_DISK) from error


def _write_scans(e57: pye57.E57, scene: Scene) -> None:
    """A scan of every camera that gave points: the format knows no empty ones."""
    fused, T_rig_depth = scene.fused, scene.fusion.T_rig_depth
    taken_s = 0.0 if scene.utc_ns is None else gps_seconds(scene.utc_ns)
    for k, camera_id in enumerate(fused.camera_ids):
        own = slice(fused.starts[k], fused.starts[k + 1])
        if own.stop > own.start:
            T = T_rig_depth[camera_id]
            points = transform_points(inverse(T), fused.points_m[own].astype(np.float64))
            header = _header(_name(scene, camera_id), T, points, taken_s)
            e57.write_scan_raw(_columns(points, fused.colors[own]), scan_header=header)


def _reason(error: Exception) -> str:
    """The library's sentence, without where in its source it comes from."""
    return str(error).partition("\n")[0]


def _name(scene: Scene, camera_id: int) -> str:
    camera = scene.calibration.camera(camera_id)
    return str(camera_id) if camera is None else camera.name


def _columns(points: Vector, colors: ImageU8) -> dict[str, Vector | ImageU8]:
    xyz = zip(("cartesianX", "cartesianY", "cartesianZ"), points.astype(np.float32).T, strict=True)
    rgb = zip(("colorRed", "colorGreen", "colorBlue"), colors.T, strict=True)
    # All are valid, which takes no bits; the library's own reader asks for the field.
    return {**dict(xyz), **dict(rgb), "cartesianInvalidState": np.zeros(len(points), np.uint8)}


def _header(name: str, T_rig_depth: Pose, points: Vector, taken_s: float) -> SimpleNamespace:
    """What the library would fill in otherwise; it takes the bounds for those of the rig frame, turned."""
    low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    bounds = {
        f"{axis}{end}": value[k]
        for k, axis in enumerate("xyz")
        for end, value in (("Minimum", low), ("Maximum", high))
    }
    return SimpleNamespace(
        name=name,
        rotation=np.array(quaternion_wxyz(T_rig_depth)),
        translation=T_rig_depth[:3, 3],
        acquisitionStart_dateTimeValue=taken_s,
        acquisitionEnd_dateTimeValue=taken_s,
        **bounds,
    )
