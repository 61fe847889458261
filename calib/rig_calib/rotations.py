"""Rotations of many poses at once; `rig_protocol.poses` has the same for one."""

import numpy as np
import numpy.typing as npt

from rig_protocol.poses import hat

Array = npt.NDArray[np.float64]

# Below this angle the closed forms lose digits to cancellation and the series hold.
_SMALL_ANGLE_RAD = 0.05
_SMALL_SINE = 1e-9


def rotation_matrices(phi: Array) -> Array:
    """Exp (C,3,3) of rotation vectors (C,3), rad (Rodrigues)."""
    sine, cosine, _ = _factors(phi)
    K = hat(phi)
    return np.asarray(np.eye(3) + sine * K + cosine * (K @ K))


def right_jacobians(phi: Array) -> Array:
    """Right Jacobians (C,3,3) of rotation vectors (C,3): Exp(φ + δ) = Exp(φ) · Exp(J δ) to first order."""
    _, cosine, cubic = _factors(phi)
    K = hat(phi)
    return np.asarray(np.eye(3) - cosine * K + cubic * (K @ K))


def rotation_vectors(R: Array) -> Array:
    """Log (C,3), rad, norm ≤ π, of rotation matrices (C,3,3), at any angle."""
    q = quaternions(R)
    sine = np.linalg.norm(q[:, 1:], axis=1)
    small = sine < _SMALL_SINE
    scale = np.where(small, 2.0, 2.0 * np.arctan2(sine, q[:, 0]) / np.where(small, 1.0, sine))
    return np.asarray(scale[:, None] * q[:, 1:])


def quaternions(R: Array) -> Array:
    """Unit quaternions (N,4) as (w, x, y, z), w ≥ 0, of rotation matrices (N,3,3), at any angle."""
    product = np.empty((len(R), 4, 4))  # 4 q qᵀ, of which the row with the largest diagonal is taken
    trace = np.einsum("nii->n", R)
    product[:, 0, 0] = 1.0 + trace
    product[:, 1:, 1:] = R + R.transpose(0, 2, 1) + (1.0 - trace)[:, None, None] * np.eye(3)
    for k, (row, column) in enumerate(((2, 1), (0, 2), (1, 0)), start=1):
        product[:, 0, k] = product[:, k, 0] = R[:, row, column] - R[:, column, row]
    largest = np.einsum("nii->ni", product).argmax(axis=1)
    q = product[np.arange(len(R)), largest]
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    return np.asarray(np.where(q[:, :1] < 0, -q, q))


def rotations_of(q: Array) -> Array:
    """Rotation matrices (N,3,3) of unit quaternions (N,4) as (w, x, y, z)."""
    K = hat(q[:, 1:])
    return np.asarray(np.eye(3) + 2.0 * (q[:, 0, None, None] * K + K @ K))


def _factors(phi: Array) -> tuple[Array, Array, Array]:
    """sin θ/θ, (1 − cos θ)/θ², (θ − sin θ)/θ³, (C,1,1) each."""
    angle = np.linalg.norm(phi, axis=1)[:, None, None]
    small = angle < _SMALL_ANGLE_RAD
    s, theta = angle**2, np.where(small, 1.0, angle)
    return (
        np.where(small, 1 - s / 6 * (1 - s / 20 * (1 - s / 42)), np.sin(theta) / theta),
        np.where(small, 0.5 - s / 24 * (1 - s / 30 * (1 - s / 56)), (1 - np.cos(theta)) / theta**2),
        np.where(small, 1 / 6 - s / 120 * (1 - s / 42 * (1 - s / 72)), (theta - np.sin(theta)) / theta**3),
    )
