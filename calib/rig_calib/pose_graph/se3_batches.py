"""SE(3) on stacks of N poses (N,4,4): what `rig_protocol.poses` does for one, and the exact Jacobian of Log.

Tangent vectors (N,6) are (rotation vector in rad, translation in m), applied on the right.
"""

import numpy as np
import numpy.typing as npt

from rig_calib.rotations import right_jacobians, rotation_matrices, rotation_vectors
from rig_protocol.poses import hat

Array = npt.NDArray[np.float64]

# Below this angle the closed forms lose digits to cancellation and the series hold.
_SMALL_ANGLE_RAD = 0.05


def inverses(T: Array) -> Array:
    """Inverse of each pose."""
    out = np.zeros_like(T)
    R_inverse = T[:, :3, :3].transpose(0, 2, 1)
    out[:, :3, :3] = R_inverse
    out[:, :3, 3] = -(R_inverse @ T[:, :3, 3:])[..., 0]
    out[:, 3, 3] = 1.0
    return out


def adjoints(T: Array) -> Array:
    """Adjoint (N,6,6) of each pose: T · Exp(δ) · T⁻¹ = Exp(Ad δ)."""
    R = T[:, :3, :3]
    out = np.zeros((len(T), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = R
    out[:, 3:, :3] = hat(T[:, :3, 3]) @ R
    return out


def exponentials(delta: Array) -> Array:
    """T (N,4,4) of tangent vectors (N,6)."""
    phi, rho = delta[:, :3], delta[:, 3:]
    T = np.zeros((len(delta), 4, 4))
    T[:, :3, :3] = rotation_matrices(phi)
    T[:, :3, 3] = (right_jacobians(-phi) @ rho[..., None])[..., 0]  # the left Jacobian of φ
    T[:, 3, 3] = 1.0
    return T


def logarithms(T: Array) -> Array:
    """Tangent vectors (N,6) of poses; the rotation's norm is at most π."""
    phi = rotation_vectors(T[:, :3, :3])
    angle = np.linalg.norm(phi, axis=1)
    K = hat(phi)
    V_inverse = np.eye(3) - 0.5 * K + _cotangent_terms(angle)[2][:, None, None] * (K @ K)
    return np.concatenate([phi, (V_inverse @ T[:, :3, 3:])[..., 0]], axis=1)


def inverse_right_jacobians(delta: Array) -> Array:
    """d Log(T · Exp(ε)) / dε (N,6,6) where Log(T) = δ.

    The series of x/(1 − e⁻ˣ) in ad(δ), closed with the minimal polynomial ad (ad² + θ²)² = 0
    (Eade, "Lie groups for computer vision").
    """
    a, b, _ = _cotangent_terms(np.linalg.norm(delta[:, :3], axis=1))
    ad = np.zeros((len(delta), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = hat(delta[:, :3])
    ad[:, 3:, :3] = hat(delta[:, 3:])
    squared = ad @ ad
    even = a[:, None, None] * squared + b[:, None, None] * (squared @ squared)
    return np.asarray(np.eye(6) + 0.5 * ad + even)


def _cotangent_terms(angle: Array) -> tuple[Array, Array, Array]:
    """Coefficients of ad² and ad⁴ in the Jacobian's inverse, and of φ^² in that of SO(3)."""
    small = angle < _SMALL_ANGLE_RAD
    s, theta = angle**2, np.where(small, 1.0, angle)
    half = 0.5 * theta
    value = half * np.cos(half) / np.sin(half)  # x/2 coth x/2 at x = iθ
    slope = (half / np.sin(half) ** 2 - np.cos(half) / np.sin(half)) / (4.0 * theta)  # by x²
    a = np.where(small, 1 / 12 - s**2 / 30240, (2 * (1 - value) - theta**2 * slope) / theta**2)
    b = np.where(small, -1 / 720 - s / 15120, (1 - value - theta**2 * slope) / theta**4)
    return a, b, np.where(small, 1 / 12 + s / 720, (1 - value) / theta**2)
