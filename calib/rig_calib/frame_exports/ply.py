"""Clouds as PLY files, binary, in metres in the rig frame."""

from pathlib import Path

from rig_calib.frame_exports.frame_files import Scene, export_scenes
from rig_calib.frame_exports.job import Exported, ExportJob
from rig_calib.fusion.cloud import PointCloud
from rig_calib.fusion.ply import write_ply


def export(job: ExportJob) -> Exported:
    """A cloud a panoramic frame."""
    return export_scenes(job, "cloud", ".ply", _write)


def _write(path: Path, scene: Scene) -> None:
    write_ply(path, PointCloud(scene.fused.points_m, scene.fused.colors))
