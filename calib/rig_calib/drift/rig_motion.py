"""The motion that all cameras have in common: the rig was pushed, no camera in it."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from rig_calib.drift.motion import Motion
from rig_calib.drift.movement_test import LOOK_FLOOR
from rig_protocol.poses import Pose, adjoint, inverse

Array = npt.NDArray[np.float64]

_STEPS = 10
_LEAST_CAMERAS = 3  # of fewer nobody can say who stayed
_METRE_OF_RADIAN = np.diag(np.repeat([2.0, 1.0], 3))  # a turn moves what is seen, at some 2 m
_KERNEL_M = 0.002


def rig_motion(motions: Mapping[int, Motion], poses: Mapping[int, Pose]) -> Array:
    """Motion ξ (6,) of the rig that most cameras share, T_room_rig · Exp(ξ); zero when few are seen.

    Cauchy's kernel on what remains of each camera's motion, from no motion on: cameras that stayed outvote
    one that moved.
    """
    common: Array = np.zeros(6)
    if len(motions) < _LEAST_CAMERAS:
        return common
    maps = {k: adjoint(inverse(poses[k])) for k in motions}
    weights = {k: np.linalg.inv(np.linalg.inv(one.information) + LOOK_FLOOR) for k, one in motions.items()}
    for _ in range(_STEPS):
        information, right = np.zeros((6, 6)), np.zeros(6)
        for k, motion in motions.items():
            left_m = np.linalg.norm(_METRE_OF_RADIAN @ (motion.delta - maps[k] @ common))
            weighted = maps[k].T @ weights[k] / (1 + (left_m / _KERNEL_M) ** 2)
            information += weighted @ maps[k]
            right += weighted @ motion.delta
        common = np.asarray(np.linalg.solve(information, right), dtype=np.float64)
    return common


def motion_in_rig(common: Array, T_rig_camera: Pose) -> Array:
    """What the rig's motion is for one of its cameras."""
    return adjoint(inverse(T_rig_camera)) @ common
