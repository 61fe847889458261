"""A small rigid motion estimated from many weak measurements, some of which are wrong."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.projection import project_jacobian
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import hat

Array = npt.NDArray[np.float64]

_STEPS = 6
_KERNEL_SIGMAS = 2.4  # Cauchy's kernel at 95 % efficiency
_TELLING_SIGMAS = 4.0
_MEDIAN_OF_CHI2 = {1: 0.455, 2: 1.386}


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """By how much a camera moved: T_new = T · Exp(delta), (rotation rad, translation m), and how well known.

    `agreement` is the share of the measurements that the motion explains.
    """

    delta: Array
    information: Array
    agreement: float


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """N measurements of two whitened rows (N,2), the second zero where one row is all, and d/dδ (N,2,6)."""

    residual: Array
    jacobian: Array
    rows: int

    def __len__(self) -> int:
        """How many there are."""
        return len(self.residual)

    def votes(self, delta: Array) -> tuple[int, float]:
        """How many can tell a motion from none (4 σ), and the share of them that is for the motion."""
        expected = self.jacobian @ delta
        telling = np.einsum("nk,nk->n", expected, expected) > _TELLING_SIGMAS**2
        # |r − e|² < |r|²
        agreeing = np.einsum("nk,nk->n", expected, 2 * self.residual - expected) > 0
        count = int(telling.sum())
        return count, float((agreeing & telling).sum()) / max(count, 1)


def move_points(points: Array) -> Array:
    """Derivative (N,3,6) of points in a camera's frame by the camera's motion: −(t + ω × p)."""
    out = np.empty((len(points), 3, 6))
    out[:, :, :3] = hat(points)
    out[:, :, 3:] = -np.eye(3)
    return out


def pixel_jacobian(camera: Intrinsics, points: Array) -> Array:
    """Derivative (N,2,6) of the pixels of points (N,3) by the camera's motion."""
    return np.asarray(project_jacobian(camera, points) @ move_points(points))


def estimate_motion(measured: tuple[Measurements, ...], start: Array | None = None) -> Motion | None:
    """Robust least squares; None when the measurements leave it open."""
    delta = np.zeros(6) if start is None else start
    information, agreement, count = np.zeros((6, 6)), 0.0, sum(map(len, measured))
    for _ in range(_STEPS):
        information, right, agreement = np.zeros((6, 6)), np.zeros(6), 0.0
        for part in measured:
            if not len(part):
                continue
            residual = part.residual - part.jacobian @ delta
            chi2 = np.einsum("nk,nk->n", residual, residual)
            variance = max(float(np.median(chi2)) / _MEDIAN_OF_CHI2[part.rows], 1.0)
            share = 1.0 / (1.0 + chi2 / (_KERNEL_SIGMAS**2 * variance))
            weighted = part.jacobian * (share / variance)[:, None, None]
            information += np.einsum("nki,nkj->ij", weighted, part.jacobian)
            right += np.einsum("nki,nk->i", weighted, part.residual)
            agreement += float(share.sum())
        try:
            delta = np.asarray(np.linalg.solve(information, right), dtype=np.float64)
        except np.linalg.LinAlgError:
            return None
    return Motion(delta, information, agreement / max(count, 1))
