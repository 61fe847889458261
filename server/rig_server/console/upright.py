"""Which way an image must be turned for up to be up: the Kinects of the ring lie on their side."""

from collections.abc import Mapping

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.fusion.viewpoint import rig_viewpoint
from rig_protocol.frames import ImageU8
from rig_protocol.gravity import Gravity
from rig_protocol.poses import Pose
from rig_protocol.rig_folder import RigDescription

_ROTATIONS = {1: cv2.ROTATE_90_CLOCKWISE, 2: cv2.ROTATE_180, 3: cv2.ROTATE_90_COUNTERCLOCKWISE}
_LEAST_TILT = 0.3  # of a unit vector: a camera that looks up or down has no upright


def quarter_turns(up: npt.NDArray[np.float64]) -> int:
    """Quarter turns clockwise after which the image direction `up` (x right, y down, ...) points up."""
    x, y = float(up[0]), float(up[1])
    if max(abs(x), abs(y)) < _LEAST_TILT:
        return 0
    if abs(x) > abs(y):
        return 1 if x < 0 else 3
    return 0 if y < 0 else 2


def felt_turns(gravity: Gravity) -> int:
    """Quarter turns clockwise by what the camera's accelerometer felt."""
    return quarter_turns(-np.array(gravity.down))


def drawn_turns(
    description: RigDescription, poses: Mapping[int, Pose] | None, rig_frame: str = "ring"
) -> dict[int, int]:
    """Quarter turns by camera id, by its pose T_rig_camera, calibrated or else drawn; without one none."""
    if not poses:
        known = {camera.id: camera.T_rig_camera for camera in description.cameras}
        poses, rig_frame = {i: T for i, T in known.items() if T is not None}, "ring"
    if not poses:
        return {}
    up = rig_viewpoint(poses, rig_frame).T_rig_view[:3, 2]
    return {camera_id: quarter_turns(T[:3, :3].T @ up) for camera_id, T in poses.items()}


def turned(image: ImageU8, turns: int) -> ImageU8:
    """The image, turned clockwise."""
    return image if turns == 0 else np.asarray(cv2.rotate(image, _ROTATIONS[turns]), np.uint8)
