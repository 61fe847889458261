"""Rigid transforms on SE(3) as 4×4 arrays. `T_a_b` maps points from frame b to frame a.

Tangent vectors are (rotation vector in rad, translation in m), applied on the right: T · Exp(δ).
Equations: Barfoot, State Estimation for Robotics, ch. 7.
"""

import numpy as np
import numpy.typing as npt

Pose = npt.NDArray[np.float64]
Vector = npt.NDArray[np.float64]

# Below this the closed forms lose digits to cancellation and the series hold to 1e-14.
_SMALL_ANGLE_RAD = 1e-3


def hat(v: Vector) -> Vector:
    """Skew matrix (...,3,3) of vectors (...,3): hat(a) @ b = a × b."""
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def so3_exp(phi: Vector) -> Vector:
    """Rotation matrix (3,3) of a rotation vector (3,), rad (Rodrigues)."""
    a, b, _ = _series(float(np.linalg.norm(phi)))
    K = hat(phi)
    return np.asarray(np.eye(3) + a * K + b * (K @ K))


def so3_log(R: Vector) -> Vector:
    """Rotation vector (3,), rad, norm ≤ π, of a rotation matrix (3,3)."""
    axis = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sin, cos = float(np.linalg.norm(axis)), 0.5 * (float(np.trace(R)) - 1.0)
    angle = float(np.arctan2(sin, cos))
    if angle < _SMALL_ANGLE_RAD:
        return axis
    if np.pi - angle > 1e-4:
        return np.asarray(axis * (angle / sin))
    # Near π the skew part vanishes; the axis is the largest column of R + I.
    S = 0.5 * (R + R.T) + np.eye(3)
    column = S[:, int(np.argmax(np.diag(S)))]
    n = column / np.linalg.norm(column)
    return np.asarray(n * angle * (1.0 if n @ axis >= 0 else -1.0))


def left_jacobian(phi: Vector) -> Vector:
    """Left Jacobian of SO(3), (3,3): the V of the SE(3) exponential."""
    _, b, c = _series(float(np.linalg.norm(phi)))
    K = hat(phi)
    return np.asarray(np.eye(3) + b * K + c * (K @ K))


def se3_exp(delta: Vector) -> Pose:
    """T (4,4) of a tangent vector (6,): rotation vector (rad), then translation part (m)."""
    delta = np.asarray(delta, dtype=np.float64)
    T = np.eye(4)
    T[:3, :3] = so3_exp(delta[:3])
    T[:3, 3] = left_jacobian(delta[:3]) @ delta[3:]
    return T


def se3_log(T: Pose) -> Vector:
    """Tangent vector (6,) of T (4,4); the inverse of `se3_exp`."""
    phi = so3_log(T[:3, :3])
    return np.concatenate([phi, np.linalg.solve(left_jacobian(phi), T[:3, 3])])


def inverse(T: Pose) -> Pose:
    """T_b_a from T_a_b (4,4)."""
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return out


def adjoint(T: Pose) -> Vector:
    """Adjoint (6,6): T · Exp(δ) · T⁻¹ = Exp(Ad δ), rotation first."""
    R, t = T[:3, :3], T[:3, 3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[3:, :3] = hat(t) @ R
    return out


def transform_points(T: Pose, points: Vector) -> Vector:
    """Points (...,3) moved by T (4,4)."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def rotation_angle_deg(T: Pose) -> float:
    """Angle of the rotation part of T, degrees."""
    return float(np.rad2deg(np.linalg.norm(so3_log(T[:3, :3]))))


def is_pose(T: npt.NDArray[np.float64]) -> bool:
    """True for a finite 4×4 rigid transform (orthonormal to 1e-4, right-handed)."""
    if T.shape != (4, 4) or not np.isfinite(T).all() or not np.allclose(T[3], (0, 0, 0, 1)):
        return False
    R = T[:3, :3]
    return bool(np.allclose(R @ R.T, np.eye(3), atol=1e-4) and np.linalg.det(R) > 0)


def _series(angle: float) -> tuple[float, float, float]:
    """sin θ/θ, (1 − cos θ)/θ², (θ − sin θ)/θ³."""
    if angle < _SMALL_ANGLE_RAD:
        return 1.0 - angle**2 / 6, 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120
    sin, cos = np.sin(angle), np.cos(angle)
    return float(sin / angle), float((1 - cos) / angle**2), float((angle - sin) / angle**3)
