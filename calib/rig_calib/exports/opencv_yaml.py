"""OpenCV's own YAML, for cv::FileStorage: matrices as cv::undistort and cv::projectPoints take them.

`rvec` and `tvec` map points of the rig's frame into the camera, as projectPoints wants them; `T_rig_camera`
is the inverse, 4×4.
"""

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rig_calib.exports.exported_rig import Export, ExportedCamera, ExportedRig
from rig_protocol.camera import Intrinsics, as_pose
from rig_protocol.errors import DataError
from rig_protocol.poses import inverse

FILE = "rig.yaml"

Matrix = npt.NDArray[np.float64]


def export(rig: ExportedRig) -> Export:
    """A sequence `cameras` of maps; depth camera and T_color_depth where they are known."""
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.startWriteStruct("cameras", cv2.FILE_NODE_SEQ)
    for camera, color in zip(rig.cameras, rig.colors(), strict=True):
        storage.startWriteStruct("", cv2.FILE_NODE_MAP)
        storage.write("name", camera.name)
        storage.write("image_width", color.width)
        storage.write("image_height", color.height)
        for key, matrix in _matrices(camera, color).items():
            storage.write(key, matrix)
        storage.endWriteStruct()
    storage.endWriteStruct()
    # OpenCV 4 writes a directive that no other YAML reader takes; it reads the standard one as well.
    text = str(storage.releaseAndGetString()).replace("%YAML:1.0", "%YAML 1.2", 1)
    return Export({FILE: text})


def read_opencv(text: str) -> ExportedRig:
    """Cameras of a file that `export` wrote; DataError when it is none."""
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        nodes = storage.getNode("cameras")
        cameras = [_camera(nodes.at(n)) for n in range(nodes.size())]
    except (cv2.error, SystemError, AttributeError, IndexError, TypeError, ValueError) as error:
        raise DataError(f"not an OpenCV file of rig-calib export: {error!r}") from error
    if not cameras:
        raise DataError("not an OpenCV file of rig-calib export: it holds no `cameras`")
    return ExportedRig(tuple(cameras))


def _matrices(camera: ExportedCamera, color: Intrinsics) -> dict[str, Matrix]:
    T_camera_rig = inverse(camera.T_rig_camera)
    matrices = {
        "camera_matrix": _camera_matrix(color),
        "distortion_coefficients": np.array([color.dist]),
        "T_rig_camera": camera.T_rig_camera,
        "rvec": Rotation.from_matrix(T_camera_rig[:3, :3]).as_rotvec().reshape(3, 1),
        "tvec": np.ascontiguousarray(T_camera_rig[:3, 3:]),
    }
    if camera.depth is not None and camera.T_color_depth is not None:
        matrices["depth_size"] = np.array([[camera.depth.width, camera.depth.height]], dtype=np.float64)
        matrices["depth_camera_matrix"] = _camera_matrix(camera.depth)
        matrices["depth_distortion_coefficients"] = np.array([camera.depth.dist])
        matrices["T_color_depth"] = camera.T_color_depth
    return matrices


def _camera_matrix(camera: Intrinsics) -> Matrix:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])


def _camera(node: Any) -> ExportedCamera:
    color = _intrinsics(
        node.getNode("camera_matrix").mat(),
        node.getNode("distortion_coefficients").mat(),
        (node.getNode("image_width").real(), node.getNode("image_height").real()),
    )
    T = as_pose(node.getNode("T_rig_camera").mat(), "T_rig_camera")
    name = str(node.getNode("name").string())
    if node.getNode("depth_camera_matrix").empty():
        return ExportedCamera(name, T, color)
    depth = _intrinsics(
        node.getNode("depth_camera_matrix").mat(),
        node.getNode("depth_distortion_coefficients").mat(),
        node.getNode("depth_size").mat().ravel().tolist(),
    )
    return ExportedCamera(
        name, T, color, depth, as_pose(node.getNode("T_color_depth").mat(), "T_color_depth")
    )


def _intrinsics(K: Matrix, dist: Matrix, size: Any) -> Intrinsics:
    k1, k2, p1, p2, k3 = np.ravel(dist).tolist()
    width, height = (int(side) for side in size)
    fx, fy, cx, cy = (float(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Intrinsics(fx, fy, cx, cy, width, height, (k1, k2, p1, p2, k3))
