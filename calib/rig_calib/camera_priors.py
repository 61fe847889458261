"""What is known of cameras before they are looked at, as a cost, its gradient and its information."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.rotations import rotation_vectors
from rig_protocol.poses import Pose, inverse

Array = npt.NDArray[np.float64]

# The kernel of a pose prior bends at the 95 % quantile of its six numbers: a camera may be far from its
# drawing.
_BEND = 12.6


@dataclass(frozen=True, slots=True, eq=False)
class CameraPriors:
    """Priors of C cameras. Weights are 1/σ, zero for what is not known.

    On the pose: T_prior⁻¹ · T = (rotation vector, translation) is zero with `pose_weight` (C,6), through a
    Cauchy kernel. On the states beside it: `expected` (C,S−6) with `weight` (C,S−6).
    """

    T_camera_prior: Array
    pose_weight: Array
    expected: Array
    weight: Array

    def cost(self, T_rig_camera: Array, beside_pose: Array) -> float:
        """Negative log likelihood of states."""
        squares = (self._pose_error(T_rig_camera) ** 2).sum(axis=1)
        others = (beside_pose - self.expected) * self.weight
        return float(0.5 * _BEND * np.log1p(squares / _BEND).sum() + 0.5 * (others**2).sum())

    def normal_equations(self, T_rig_camera: Array, beside_pose: Array) -> tuple[Array, Array]:
        """Diagonal of the information (C,S) and gradient (C,S) at states."""
        error = self._pose_error(T_rig_camera)
        kernel = 1.0 / (1.0 + (error**2).sum(axis=1, keepdims=True) / _BEND)
        others = (beside_pose - self.expected) * self.weight
        information = np.concatenate([kernel * self.pose_weight**2, self.weight**2], axis=1)
        return information, np.concatenate([kernel * error * self.pose_weight, others * self.weight], axis=1)

    def _pose_error(self, T_rig_camera: Array) -> Array:
        difference = self.T_camera_prior @ T_rig_camera
        turn = rotation_vectors(difference[:, :3, :3])
        return np.concatenate([turn, difference[:, :3, 3]], axis=1) * self.pose_weight


def weights_of(sigma: Array) -> Array:
    """1/σ, and zero where σ is zero, which stands for a state that is held."""
    return np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0.0)


def prior_pose(T: Pose | None, sigma: Array | None) -> tuple[Pose, Array]:
    """T_camera_prior (4,4) and weights (6,) of a camera's pose prior, which it may lack."""
    if T is None or sigma is None:
        return np.eye(4), np.zeros(6)
    return inverse(T), 1.0 / np.asarray(sigma)
