"""Rotations of many cameras at once; `rig_protocol.poses` has the same for one."""

import numpy as np
import numpy.typing as npt

from rig_protocol.poses import hat, so3_log

Array = npt.NDArray[np.float64]

_NEAR_HALF_TURN = 1e-2  # of sin φ, where the skew part says too little of the axis
_SMALL_SQUARED_ANGLE = 1e-6


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
    """Log (C,3), rad, norm ≤ π, of rotation matrices (C,3,3)."""
    axis = 0.5 * (R[:, (2, 0, 1), (1, 2, 0)] - R[:, (1, 2, 0), (2, 0, 1)])
    sine, cosine = np.sqrt((axis**2).sum(axis=1)), 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0)
    scale = np.divide(np.arctan2(sine, cosine), sine, out=np.ones_like(sine), where=sine > 1e-9)
    out = axis * scale[:, None]
    for c in np.flatnonzero((cosine < 0.0) & (sine < _NEAR_HALF_TURN)):
        out[c] = so3_log(R[c])
    return np.asarray(out)


def _factors(phi: Array) -> tuple[Array, Array, Array]:
    """sin θ/θ, (1 − cos θ)/θ², (θ − sin θ)/θ³, (C,1,1) each."""
    square = (phi**2).sum(axis=1)[:, None, None]
    angle = np.sqrt(square)
    sine, half = np.sinc(angle / np.pi), np.sinc(angle / (2.0 * np.pi))
    cubic = np.divide(1.0 - sine, square, out=1.0 / 6.0 - square / 120.0, where=square > _SMALL_SQUARED_ANGLE)
    return sine, 0.5 * half**2, cubic
