"""Panoramas as OpenEXR files: R, G, B in linear light, Z in metres, and the projection as attributes."""

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from rig_calib.frame_exports.frame_files import Scene, export_scenes
from rig_calib.frame_exports.job import Exported, ExportJob
from rig_calib.frame_exports.panorama_geometry import panorama_geometry
from rig_calib.fusion.linear_light import LINEAR_LIGHT
from rig_calib.whole_file import whole_file


def export(job: ExportJob) -> Exported:
    """A file a panoramic frame."""
    return export_scenes(job, "panorama", ".exr", _write)


_LINEAR_LIGHT = LINEAR_LIGHT.astype(np.float16)  # all differ


def _write(path: Path, scene: Scene) -> None:
    light = _LINEAR_LIGHT[scene.fused.panorama]
    depth_m = scene.fused.panorama_depth_m
    channels = {name: np.ascontiguousarray(light[..., 2 - k]) for k, name in enumerate("RGB")}
    # Where nothing was measured nothing is known to stand: compositing programs take infinity for that.
    channels["Z"] = np.where(np.isfinite(depth_m), depth_m, np.float32(np.inf))
    with whole_file(path) as file:
        OpenEXR.File(_header(scene), channels).write(file)


def _header(scene: Scene) -> dict[str, Any]:
    """Standard attributes, and `panorama_geometry` in those that begin with kinectRig."""
    geometry = panorama_geometry(scene.fusion, scene.calibration)
    return {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "software": "kinect-rig",
        "comments": "cylinder about z of the view frame; Z: metres from its axis, infinite where nothing is",
        "kinectRigProjection": geometry["projection"],
        "kinectRigRadiansPerPixel": float(geometry["radians_per_pixel"]),
        "kinectRigAzimuthLeft": float(geometry["azimuth_left_rad"]),
        "kinectRigSlopeTop": float(geometry["slope_top"]),
        "kinectRigCentre": scene.fusion.T_rig_view[:3, 3].astype(np.float32),
        "kinectRigView": scene.fusion.T_rig_view.astype(np.float32),
        "kinectRigFrame": geometry["rig_frame"],
        "kinectRigCalibration": geometry["calibration"],
        "kinectRigIndex": scene.fused.index,
    }
