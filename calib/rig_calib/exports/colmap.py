"""COLMAP: rig_config.json for `colmap rig_configurator` (3.12 and later), with images also a text model.

https://colmap.github.io/rigs.html and format.html. Axes are OpenCV's, quaternions (w, x, y, z), and
`cam_from_rig` maps from the reference sensor, the first camera, to the camera. The centre of the first pixel
is (0.5, 0.5): principal points are half a pixel larger than OpenCV's. The model's world is the rig's frame.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rig_calib.exports.exported_rig import Export, ExportedCamera, ExportedRig
from rig_calib.exports.rotations import pose_of_quaternion, quaternion_wxyz
from rig_protocol.camera import Intrinsics
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.poses import Pose, inverse

RIG_CONFIG = "rig_config.json"
IMAGE_LIST = "image_list.txt"
MODEL_FILES = tuple(f"sparse/{name}.txt" for name in ("cameras", "rigs", "frames", "images", "points3D"))

_HALF_PIXEL = 0.5
_RIG_ID = 1


def export(rig: ExportedRig) -> Export:
    """rig_config.json; with images also a list of them and the sparse model with every pose and no point."""
    colors = rig.colors()
    files = {RIG_CONFIG: json.dumps(_rig_config(rig, colors), indent=1) + "\n"}
    if any(camera.images for camera in rig.cameras):
        _refuse_spaces(rig)
        files |= _sparse_model(rig, colors)
        files[IMAGE_LIST] = "".join(f"{name}\n" for _, _, name in _images(rig))
    return Export(files)


def read_rig_config(text: str) -> ExportedRig:
    """Cameras of a rig_config.json, posed in the frame of the reference sensor; DataError when it is none."""
    cameras = []
    try:
        (config,) = json.loads(text)
        for values in config["cameras"]:
            T = np.eye(4)
            if not values.get("ref_sensor"):
                T = inverse(
                    pose_of_quaternion(values["cam_from_rig_rotation"], values["cam_from_rig_translation"])
                )
            color = _intrinsics(values["camera_model_name"], values["camera_params"])
            cameras.append(ExportedCamera(str(values["image_prefix"]).rstrip("/"), T, color))
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"not a rig_config.json of rig-calib export: {error!r}") from error
    return ExportedRig(tuple(cameras))


def read_sparse_model(files: Mapping[str, str]) -> ExportedRig:
    """Cameras of a sparse text model that `export` wrote, posed in its world; DataError when it is none."""
    try:
        colors = {}
        for number, model, width, height, *params in _rows(files["sparse/cameras.txt"]):
            colors[number] = _intrinsics(model, [float(p) for p in params], int(width), int(height))
        cameras: dict[str, ExportedCamera] = {}
        for _, *pose, number, image in _rows(files["sparse/images.txt"]):
            numbers = [float(value) for value in pose]
            name = image.rsplit("/", 1)[0]
            images = {**(cameras[name].images if name in cameras else {})}
            images[len(images)] = image
            T = inverse(pose_of_quaternion(numbers[:4], numbers[4:]))
            cameras[name] = ExportedCamera(name, T, colors[number], images=images)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"not a sparse model of rig-calib export: {error!r}") from error
    return ExportedRig(tuple(cameras.values()))


def _rig_config(rig: ExportedRig, colors: Sequence[Intrinsics]) -> list[dict[str, Any]]:
    cameras = []
    for n, (camera, color) in enumerate(zip(rig.cameras, colors, strict=True)):
        model, params = _camera_model(color)
        values: dict[str, Any] = {"image_prefix": f"{camera.name}/"}
        if n == 0:
            values["ref_sensor"] = True
        else:
            T = _T_camera_reference(rig, n)
            values["cam_from_rig_rotation"] = quaternion_wxyz(T)
            values["cam_from_rig_translation"] = T[:3, 3].tolist()
        cameras.append(values | {"camera_model_name": model, "camera_params": params})
    return [{"cameras": cameras}]


def _sparse_model(rig: ExportedRig, colors: Sequence[Intrinsics]) -> dict[str, str]:
    """Text files of the model: camera n has id n + 1, images are numbered frame after frame."""
    cameras, sensors = [], []
    for n, color in enumerate(colors):
        model, params = _camera_model(color)
        cameras.append([n + 1, model, color.width, color.height, *params])
        sensors += ["CAMERA", n + 1] + ([] if n == 0 else [1, *_pose(_T_camera_reference(rig, n))])
    frames: dict[int, list[object]] = {}
    images = []
    for number, (frame, n, name) in enumerate(_images(rig), start=1):
        images.append([number, *_pose(inverse(rig.cameras[n].T_rig_camera)), n + 1, name])
        frames.setdefault(frame, []).extend(["CAMERA", n + 1, number])
    T_reference_world = inverse(rig.cameras[0].T_rig_camera)
    lines = [
        [number, _RIG_ID, *_pose(T_reference_world), len(data) // 3, *data]
        for number, data in enumerate(frames.values(), start=1)
    ]
    tables = (cameras, [[_RIG_ID, len(colors), *sensors]], lines)
    texts = [_text(table) for table in tables]
    # Every image has a second line for its points, of which there are none.
    texts += ["".join(_text([row]) + "\n" for row in images), ""]
    return dict(zip(MODEL_FILES, texts, strict=True))


def _refuse_spaces(rig: ExportedRig) -> None:
    for camera in rig.cameras:
        if len(camera.name.split()) != 1:
            raise ConfigurationError(
                f"COLMAP's text model separates by spaces: rename camera {camera.name!r} and its folder"
            )


def _images(rig: ExportedRig) -> list[tuple[int, int, str]]:
    """Panoramic frame, position of the camera, and name of every image."""
    return sorted(
        (frame, n, name) for n, camera in enumerate(rig.cameras) for frame, name in camera.images.items()
    )


def _T_camera_reference(rig: ExportedRig, n: int) -> Pose:
    return np.asarray(inverse(rig.cameras[n].T_rig_camera) @ rig.cameras[0].T_rig_camera)


def _pose(T: Pose) -> list[float]:
    return [*quaternion_wxyz(T), *T[:3, 3].tolist()]


def _camera_model(color: Intrinsics) -> tuple[str, list[float]]:
    """The smallest of COLMAP's models that holds the distortion."""
    pinhole = [color.fx, color.fy, color.cx + _HALF_PIXEL, color.cy + _HALF_PIXEL]
    k1, k2, p1, p2, k3 = color.dist
    if k3:
        return "FULL_OPENCV", [*pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    if any(color.dist):
        return "OPENCV", [*pinhole, k1, k2, p1, p2]
    return "PINHOLE", pinhole


def _intrinsics(model: str, params: Sequence[float], width: int = 640, height: int = 480) -> Intrinsics:
    lengths = {"PINHOLE": 4, "OPENCV": 8, "FULL_OPENCV": 12}
    if lengths.get(model) != len(params):
        raise ValueError(f"camera model {model} with {len(params)} parameters")
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = [*params, *[0.0] * 9][:9]
    return Intrinsics(fx, fy, cx - _HALF_PIXEL, cy - _HALF_PIXEL, width, height, (k1, k2, p1, p2, k3))


def _text(rows: Iterable[Sequence[object]]) -> str:
    return "".join(" ".join(map(str, row)) + "\n" for row in rows)


def _rows(text: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
