"""Clouds as LAS 1.4 files (ASPRS), in metres in the rig frame, to a tenth of a millimetre."""

from pathlib import Path

import laspy
import numpy as np

from rig_calib.frame_exports.frame_files import Scene, export_scenes
from rig_calib.frame_exports.gps_time import gps_seconds
from rig_calib.frame_exports.job import Exported, ExportJob
from rig_calib.whole_file import whole_file

_COLORED_POINTS = 7  # the point format of LAS 1.4 with GPS time and RGB
_SCALE_M = 1e-4
_ADJUSTED_S = 1e9  # LAS counts standard GPS time less this


def export(job: ExportJob) -> Exported:
    """A cloud a panoramic frame; the point source is the camera's id."""
    return export_scenes(job, "cloud", ".las", _write)


def _write(path: Path, scene: Scene) -> None:
    fused = scene.fused
    las = laspy.LasData(_header(scene))
    las.xyz = fused.points_m.astype(np.float64)
    las.red, las.green, las.blue = fused.colors.T.astype(np.uint16) * 257  # 255 becomes 65535
    las.point_source_id = np.repeat(np.array(fused.camera_ids, np.uint16), np.diff(fused.starts))
    las.return_number[:] = las.number_of_returns[:] = 1
    if scene.utc_ns is not None:
        las.gps_time = np.full(len(fused.points_m), gps_seconds(scene.utc_ns) - _ADJUSTED_S)
    with whole_file(path) as file:
        las.write(file)


def _header(scene: Scene) -> laspy.LasHeader:
    header = laspy.LasHeader(version="1.4", point_format=_COLORED_POINTS)
    header.scales, header.offsets = np.full(3, _SCALE_M), np.zeros(3)
    header.generating_software = "kinect-rig"
    header.global_encoding.wkt = True  # the standard wants it of this point format, with or without a system
    if scene.utc_ns is not None:
        header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    return header
