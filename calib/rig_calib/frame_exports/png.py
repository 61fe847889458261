"""Panoramas as PNG files, colour and depth in millimetres, and a JSON file with time and projection."""

import json
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.frame_exports.frame_files import Scene, export_scenes
from rig_calib.frame_exports.job import Exported, ExportJob
from rig_calib.frame_exports.panorama_geometry import panorama_geometry
from rig_calib.whole_file import whole_file
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import ImageU16

_COLOR, _DEPTH = "panorama", "panorama_depth"


def export(job: ExportJob) -> Exported:
    """Two images a panoramic frame; ConfigurationError where `out` is named like one of them."""
    if job.out.suffix == ".png":
        raise ConfigurationError(f"two images a panoramic frame are written: name a folder, not {job.out}")
    return export_scenes(job, _COLOR, ".png", _write)


def _write(path: Path, scene: Scene) -> None:
    times = {"timestamp_ns": scene.fused.timestamp_ns, "utc_ns": scene.utc_ns}
    about = {**times, **panorama_geometry(scene.fusion, scene.calibration)}
    with whole_file(path.with_suffix(".json")) as file:
        file.write(json.dumps(about, indent=1).encode() + b"\n")
    _write_image(path, scene.fused.panorama)
    depth = path.with_name(path.name.replace(_COLOR, _DEPTH, 1))
    _write_image(depth, _millimetres(scene.fused.panorama_depth_m))


def _millimetres(depth_m: npt.NDArray[np.float32]) -> ImageU16:
    """Depth in whole millimetres, 0 where there is none."""
    known = np.nan_to_num(depth_m.astype(np.float64), nan=0.0) * 1e3
    return np.asarray(np.rint(known.clip(0, np.iinfo(np.uint16).max)), np.uint16)


def _write_image(path: Path, image: npt.NDArray[np.uint8] | ImageU16) -> None:
    made, data = cv2.imencode(".png", image)
    if not made:
        raise DataError(f"{path}: the panorama could not be encoded as PNG")
    with whole_file(path) as file:
        file.write(data.tobytes())
