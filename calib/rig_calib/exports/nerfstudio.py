"""nerfstudio's transforms.json: images with their poses, camera to world, in OpenGL axes.

https://docs.nerf.studio/quickstart/data_conventions.html. Cameras: x right, y up, z backwards, so the y and z
axes of OpenCV change sign; the world (the rig's frame) has z up and stays. Pixel centres are at half
integers: principal points are half a pixel larger than OpenCV's.
"""

import json
from posixpath import join, normpath
from typing import Any

import numpy as np

from rig_calib.exports.exported_rig import Export, ExportedCamera, ExportedRig
from rig_protocol.camera import Intrinsics, as_pose
from rig_protocol.errors import DataError

FILE = "transforms.json"

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_HALF_PIXEL = 0.5
_DISTORTION = ("k1", "k2", "p1", "p2", "k3")  # in OpenCV's order


def export(rig: ExportedRig) -> Export:
    """One frame an image, with its camera's intrinsics; without images one a camera, by its usual name."""
    frames = []
    for camera, color in zip(rig.cameras, rig.colors(), strict=True):
        pose = (camera.T_rig_camera @ _OPENGL_FROM_OPENCV).tolist()
        for name in camera.images.values() or [f"{camera.name}/color_000.png"]:
            path = normpath(join(rig.image_root, name))
            frames.append({"file_path": path, **_intrinsics(color), "transform_matrix": pose})
    # nerfstudio would turn the world so that the images' y axes point up on average; those of upright
    # Kinects lie in the horizon, and the rig's z is up already.
    values = {"camera_model": "OPENCV", "orientation_override": "none", "frames": frames}
    notes = [] if any(camera.images for camera in rig.cameras) else [_without_images(frames[0]["file_path"])]
    return Export({FILE: json.dumps(values, indent=1) + "\n"}, notes)


def read_transforms(text: str) -> ExportedRig:
    """Cameras of a transforms.json that `export` wrote, named after the folders of their images.

    DataError when it is none.
    """
    cameras: dict[str, ExportedCamera] = {}
    images: dict[str, dict[int, str]] = {}
    try:
        for frame in json.loads(text)["frames"]:
            path = str(frame["file_path"])
            name = path.split("/")[-2]
            T = as_pose(frame["transform_matrix"], "transform_matrix") @ _OPENGL_FROM_OPENCV
            own = images.setdefault(name, {})
            own[len(own)] = path
            cameras[name] = ExportedCamera(name, T, _read_intrinsics(frame), images=own)
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"not a transforms.json of rig-calib export: {error!r}") from error
    return ExportedRig(tuple(cameras.values()))


def _intrinsics(color: Intrinsics) -> dict[str, Any]:
    return {
        "w": color.width,
        "h": color.height,
        "fl_x": color.fx,
        "fl_y": color.fy,
        "cx": color.cx + _HALF_PIXEL,
        "cy": color.cy + _HALF_PIXEL,
        **dict(zip(_DISTORTION, color.dist, strict=True)),
    }


def _read_intrinsics(frame: dict[str, Any]) -> Intrinsics:
    k1, k2, p1, p2, k3 = (float(frame[key]) for key in _DISTORTION)
    return Intrinsics(
        float(frame["fl_x"]),
        float(frame["fl_y"]),
        float(frame["cx"]) - _HALF_PIXEL,
        float(frame["cy"]) - _HALF_PIXEL,
        int(frame["w"]),
        int(frame["h"]),
        (k1, k2, p1, p2, k3),
    )


def _without_images(example: str) -> str:
    return (
        f"no images were given: put them beside {FILE} as {example}, ..., or give --rig with the rig folder"
    )
