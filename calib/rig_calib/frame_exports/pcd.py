"""Clouds as PCD files of the Point Cloud Library, binary, in metres in the rig frame."""

from pathlib import Path

import numpy as np
from pypcd4.pypcd4 import Encoding, PointCloud

from rig_calib.frame_exports.frame_files import Scene, export_scenes
from rig_calib.frame_exports.job import Exported, ExportJob
from rig_calib.whole_file import whole_file


def export(job: ExportJob) -> Exported:
    """A cloud a panoramic frame."""
    return export_scenes(job, "cloud", ".pcd", _write)


def _write(path: Path, scene: Scene) -> None:
    """Fields x y z rgb, all float; rgb holds the bits 0x00rrggbb, as PCL has it."""
    rgb = PointCloud.encode_rgb(scene.fused.colors)
    columns = [*scene.fused.points_m.T, rgb]
    cloud = PointCloud.from_points(columns, ("x", "y", "z", "rgb"), (np.float32,) * 4)
    with whole_file(path) as file:
        cloud.save(file, Encoding.BINARY)
