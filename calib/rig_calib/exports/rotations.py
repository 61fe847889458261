"""Rotations as the formats write them: unit quaternions, and roll, pitch and yaw that survive gimbal lock."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from rig_protocol.poses import Pose, Vector


def quaternion_wxyz(T: Pose) -> list[float]:
    """Unit quaternion (w, x, y, z), w >= 0, of the rotation of T (Hamilton)."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist()
    return [w, x, y, z]


def pose_of_quaternion(wxyz: Sequence[float], translation: Sequence[float]) -> Pose:
    """T (4,4) of a quaternion (w, x, y, z) and a translation."""
    w, x, y, z = wxyz
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    T[:3, 3] = translation
    return T


def roll_pitch_yaw(R: Vector) -> tuple[float, float, float]:
    """Angles, rad, of R (3,3) = Rz(yaw) · Ry(pitch) · Rx(roll), the fixed-axis angles of URDF.

    Each angle is measured after the one before is undone, so that the three together give R back to rounding
    even at a pitch of 90°, where an upright Kinect stands.
    """
    yaw = float(np.arctan2(R[1, 0], R[0, 0]))
    R = Rotation.from_euler("z", -yaw).as_matrix() @ R
    pitch = float(np.arctan2(-R[2, 0], R[0, 0]))
    R = Rotation.from_euler("y", -pitch).as_matrix() @ R
    return float(np.arctan2(R[2, 1], R[1, 1])), pitch, yaw


def pose_of_roll_pitch_yaw(rpy: Sequence[float], translation: Sequence[float]) -> Pose:
    """T (4,4) of URDF's angles and a translation."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", list(rpy)).as_matrix()
    T[:3, 3] = translation
    return T
