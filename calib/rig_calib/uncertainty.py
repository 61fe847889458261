"""How well the poses are known: covariances from the normal matrix of an adjustment."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.bundle_adjustment import AdjustedCamera, Adjustment
from rig_calib.observation_model import POSE
from rig_protocol.poses import Pose, adjoint, hat, inverse

Array = npt.NDArray[np.float64]

# A direction that the data says nothing about gets this information, so that its variance is a large
# number and not an error: 10 rad, 10 m.
_VAGUE_INFORMATION = 1e-2


@dataclass(frozen=True, slots=True, eq=False)
class PoseCovariance:
    """Joint covariance of the poses of C cameras: `blocks` (C,6,C,6), T_true = T · Exp(δ), rotation first."""

    blocks: Array

    def of(self, camera: int) -> Array:
        """Covariance (6,6) of one pose."""
        return np.ascontiguousarray(self.blocks[camera, :, camera, :])

    def relative(self, i: int, j: int, T_i_j: Pose) -> Array:
        """Covariance (6,6) of T_i_j, on its right: δ_ij = δ_j − Ad(T_j_i) δ_i."""
        Ad = adjoint(inverse(T_i_j))
        ii, ij, jj = self.blocks[i, :, i], self.blocks[i, :, j], self.blocks[j, :, j]
        return np.asarray(jj - Ad @ ij - ij.T @ Ad.T + Ad @ ii @ Ad.T)

    def aligned(self, poses: Sequence[Pose]) -> "PoseCovariance":
        """Joint covariance without the common turn and shift of the rig, which no relative pose depends on.

        `poses` are the C cameras' T_rig_camera. It is what is left of the errors once `align_frames` has laid
        the rig on the truth, and the same whatever the frame of the adjustment is.
        """
        count = len(poses)
        left = _alignment_residual(poses)
        whole = left @ self.blocks.reshape(6 * count, 6 * count) @ left.T
        return PoseCovariance((0.5 * (whole + whole.T)).reshape(count, 6, count, 6))


def pose_covariance(adjustment: Adjustment, cameras: Sequence[AdjustedCamera]) -> PoseCovariance:
    """Covariance of all poses with every other state marginalised.

    The frame is that of the adjustment: the fixed camera's, or the drawing's.
    """
    count = len(cameras)
    size = len(adjustment.normal) // count
    free = np.ones((count, size), dtype=bool)
    free[[c for c, camera in enumerate(cameras) if camera.fixed_pose], POSE] = False
    rows = np.flatnonzero(free)
    information = adjustment.normal[np.ix_(rows, rows)] + _VAGUE_INFORMATION * np.eye(len(rows))
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    full = np.zeros((count * size, count * size))
    full[np.ix_(rows, rows)] = 0.5 * (covariance + covariance.T)
    return PoseCovariance(full.reshape(count, size, count, size)[:, POSE, :, POSE])


def _alignment_residual(poses: Sequence[Pose]) -> Array:
    """The matrix (6C,6C) that takes the poses' δ to what `align_frames` leaves of them, to first order."""
    count = len(poses)
    to_rig = np.zeros((count, 6, count, 6))  # (turn, shift) of every camera on the axes of the rig
    for c, T in enumerate(poses):
        to_rig[c, :3, c, :3] = to_rig[c, 3:, c, 3:] = T[:3, :3]
    turn = to_rig[:, :3].mean(axis=0)  # of the rig: the mean of its cameras'
    carried = np.array([-hat(T[:3, 3]) for T in poses]) @ turn.reshape(3, -1)  # what that turn does to places
    shift = (to_rig[:, 3:].reshape(count, 3, -1) - carried).mean(axis=0)
    left = to_rig.reshape(count, 6, -1).copy()
    left[:, :3] -= turn.reshape(3, -1)
    left[:, 3:] -= carried + shift
    for c, T in enumerate(poses):
        left[c] = np.concatenate([T[:3, :3].T @ left[c, :3], T[:3, :3].T @ left[c, 3:]])
    return left.reshape(6 * count, 6 * count)


def weakest_direction(covariance: Array) -> tuple[float, float]:
    """Largest standard deviation of any rotation axis (degrees) and of any translation axis (metres)."""
    rotation = np.linalg.eigvalsh(covariance[:3, :3])[-1]
    translation = np.linalg.eigvalsh(covariance[3:, 3:])[-1]
    return float(np.rad2deg(np.sqrt(max(rotation, 0.0)))), float(np.sqrt(max(translation, 0.0)))
