"""SE(3) on stacks of N poses (N,4,4): what `rig_protocol.poses` does for one, and the exact Jacobian of Log.

Tangent vectors (N,6) are (rotation vector in rad, translation in m), applied on the right.
"""

import numpy as np
import numpy.typing as npt

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
    angle = np.linalg.norm(phi, axis=1)
    small = angle < _SMALL_ANGLE_RAD
    s, theta = angle**2, np.where(small, 1.0, angle)
    a = np.where(small, 1 - s / 6 * (1 - s / 20 * (1 - s / 42)), np.sin(theta) / theta)
    b = np.where(small, 0.5 - s / 24 * (1 - s / 30 * (1 - s / 56)), (1 - np.cos(theta)) / theta**2)
    c = np.where(small, 1 / 6 - s / 120 * (1 - s / 42 * (1 - s / 72)), (theta - np.sin(theta)) / theta**3)
    K = hat(phi)
    K_squared = K @ K
    T = np.zeros((len(delta), 4, 4))
    T[:, :3, :3] = np.eye(3) + a[:, None, None] * K + b[:, None, None] * K_squared
    V = np.eye(3) + b[:, None, None] * K + c[:, None, None] * K_squared
    T[:, :3, 3] = (V @ rho[..., None])[..., 0]
    T[:, 3, 3] = 1.0
    return T


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


def rotations(q: Array) -> Array:
    """Rotation matrices (N,3,3) of unit quaternions (N,4) as (w, x, y, z)."""
    K = hat(q[:, 1:])
    return np.asarray(np.eye(3) + 2.0 * (q[:, 0, None, None] * K + K @ K))


def logarithms(T: Array) -> Array:
    """Tangent vectors (N,6) of poses; the rotation's norm is at most π."""
    q = quaternions(T[:, :3, :3])
    sine = np.linalg.norm(q[:, 1:], axis=1)
    angle = 2.0 * np.arctan2(sine, q[:, 0])
    safe = np.where(sine < 1e-9, 1.0, sine)
    phi = np.where(sine < 1e-9, 2.0, angle / safe)[:, None] * q[:, 1:]
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
