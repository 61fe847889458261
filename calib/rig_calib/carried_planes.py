"""Planes that cameras see, carried into the rig with all that an adjustment leaves open about them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.bundle_adjustment import Adjustment
from rig_calib.observation_kernels import plane_rows
from rig_calib.observation_model import FactoryModels, PlaneObservations
from rig_calib.observed_camera import ObservedCamera

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

_STEPS = 2  # of Gauss-Newton: the start is a fit already, the weights are others
# What nothing is known of: states, and a plane whose cells lie on a line.
_VAGUE_INFORMATION = 1e-2


@dataclass(frozen=True, slots=True, eq=False)
class CarriedPlanes:
    """Planes π (K,3) in the rig frame, π · X = 1, each as one `camera` (K,) sees it.

    `covariance` (K,3,K,3) is joint, of the measurements and of the cameras' poses, depth bias and models.
    """

    camera: Index
    planes: Array
    covariance: Array

    def differences(self) -> tuple[Array, Array]:
        """Squared normal error (K,K) of every difference, and its standard deviation (K,K) in metres.

        The latter is that of the distance from the rig's origin.
        """
        own = np.einsum("aiaj->aij", self.covariance)
        cross = self.covariance.transpose(0, 2, 1, 3)
        covariance = own[:, None] + own[None] - cross - cross.transpose(0, 1, 3, 2)
        itself = np.arange(len(own))
        covariance[itself, itself] = np.eye(3)
        apart = self.planes[:, None] - self.planes[None]
        squared = np.einsum("abi,abi->ab", apart, np.linalg.solve(covariance, apart[..., None])[..., 0])
        length = np.linalg.norm(self.planes, axis=1)
        towards = self.planes / length[:, None]
        variance = np.einsum("ai,abij,aj->ab", towards, covariance, towards)
        return squared, np.sqrt(np.maximum(variance, 0.0)) / length[:, None] ** 2


def carry(
    starts: Array, seen: PlaneObservations, sides: Sequence[ObservedCamera], adjustment: Adjustment
) -> CarriedPlanes:
    """Every plane fitted to what one camera saw of it, with the cameras in the rig as `adjustment` has them.

    `starts` (K,3) are in the rig frame, `seen` is in the order of the planes. How a plane follows the states
    of its camera makes its covariance.
    """
    states, count = adjustment.states, len(starts)
    models = FactoryModels.of(
        [side.view.model.color for side in sides], [side.grid for side in sides], len(states[0].bias)
    )
    estimate = models.with_states(
        np.array([state.T_rig_camera for state in states]),
        np.array([state.beside_pose() for state in states]),
    )
    known, first = models.plane_rows(seen), np.searchsorted(seen.plane, np.arange(count))
    camera, planes = seen.camera[first], starts
    for _ in range(_STEPS):
        residual, by_state = np.zeros(len(seen)), np.zeros((len(seen), models.state_size))
        by_plane = np.zeros((len(seen), 3))
        plane_rows(estimate, known, planes, residual, by_state, by_plane)
        information = np.add.reduceat(by_plane[:, :, None] * by_plane[:, None], first)
        own = np.linalg.inv(information + _VAGUE_INFORMATION * np.eye(3))
        pull = np.add.reduceat(by_plane * residual[:, None], first)
        planes = planes - (own @ pull[..., None])[..., 0]
    follows = -own @ np.add.reduceat(by_plane[:, :, None] * by_state[:, None], first)
    covariance = _of_states(np.asarray(follows, dtype=np.float64), camera, adjustment.normal)
    covariance[np.arange(count), :, np.arange(count)] += own
    return CarriedPlanes(camera, planes, covariance)


def _of_states(follows: Array, camera: Index, normal: Array) -> Array:
    """Covariance (K,3,K,3) of planes that follow (K,3,S) the states of one camera (K,) each."""
    count, _, size = follows.shape
    by_all = np.zeros((count, 3, len(normal) // size, size))
    by_all[np.arange(count), :, camera] = follows
    flat = by_all.reshape(3 * count, -1) * (np.diag(normal) > 0.0)  # what is held does not err
    spread = np.linalg.solve(normal + _VAGUE_INFORMATION * np.eye(len(normal)), flat.T)
    return np.asarray(flat @ spread).reshape(count, 3, count, 3)
