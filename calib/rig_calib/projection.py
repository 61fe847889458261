"""Pinhole projection with OpenCV's five-coefficient distortion, its inverse and its derivatives.

Pixel centres at integer coordinates; camera frames are OpenCV's (x right, y down, z forward).
Equations: OpenCV documentation, "Camera Calibration and 3D Reconstruction".
"""

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from rig_protocol.camera import Intrinsics

Array = npt.NDArray[np.float64]

_NEWTON_STEPS = 8  # quadratic convergence from a start within 15 % of the root
_NEWTON_TOLERANCE = 1e-12


def project(intrinsics: Intrinsics, points: Array) -> Array:
    """Pixels (N,2) of points (N,3) in the camera frame, z > 0 (eq. 3 of the paper, with distortion)."""
    points = np.asarray(points, dtype=np.float64)
    return to_pixels(intrinsics, _distort(intrinsics, points[:, :2] / points[:, 2:]))


def project_jacobian(intrinsics: Intrinsics, points: Array) -> Array:
    """Derivative (N,2,3) of `project` by the points."""
    z_inverse = 1.0 / points[:, 2]
    normalised = points[:, :2] * z_inverse[:, None]
    by_normalised = _distort_jacobian(intrinsics, normalised)
    by_normalised[:, 0] *= intrinsics.fx
    by_normalised[:, 1] *= intrinsics.fy
    out = np.empty((len(points), 2, 3))
    out[:, :, :2] = by_normalised * z_inverse[:, None, None]
    out[:, :, 2] = -np.einsum("nij,nj->ni", out[:, :, :2], normalised)
    return out


def undistort_pixels(intrinsics: Intrinsics, pixels: Array) -> Array:
    """Normalised coordinates (N,2), x = X/Z and y = Y/Z, of the rays through pixels (N,2).

    Newton's method; a pixel where the distortion cannot be inverted becomes NaN.
    """
    distorted = from_pixels(intrinsics, np.asarray(pixels, dtype=np.float64))
    if not any(intrinsics.dist):
        return distorted
    normalised = distorted.copy()
    with np.errstate(all="ignore"):  # what diverges is set to NaN below
        for _ in range(_NEWTON_STEPS):
            error = _distort(intrinsics, normalised) - distorted
            if np.nanmax(np.abs(error), initial=0.0) < _NEWTON_TOLERANCE:
                break
            normalised -= _solve_2x2(_distort_jacobian(intrinsics, normalised), error)
        missed = ~(np.abs(_distort(intrinsics, normalised) - distorted).max(axis=1, initial=0.0) < 1e-6)
    normalised[missed] = np.nan
    return normalised


def distortion_inverse(intrinsics: Intrinsics, normalised: Array) -> Array:
    """Derivative (N,2,2) of undistorted normalised coordinates (N,2), given, by the distorted ones."""
    return np.asarray(np.linalg.inv(_distort_jacobian(intrinsics, normalised)))


@lru_cache(maxsize=16)  # one a camera of the rig and some to spare; 5 MB each
def pixel_rays(intrinsics: Intrinsics) -> Array:
    """Normalised coordinates (H,W,2) of the ray through every pixel; read-only."""
    v, u = np.mgrid[: intrinsics.height, : intrinsics.width].astype(np.float64)
    rays = undistort_pixels(intrinsics, np.column_stack([u.ravel(), v.ravel()]))
    rays = rays.reshape(intrinsics.height, intrinsics.width, 2)
    rays.flags.writeable = False
    return rays


def inside(intrinsics: Intrinsics, pixels: Array, margin_px: float = 0.0) -> npt.NDArray[np.bool_]:
    """Which pixels (N,2) lie in the image, grown by a margin on every side."""
    low, high = -0.5 - margin_px, np.array([intrinsics.width, intrinsics.height]) - 0.5 + margin_px
    return np.asarray(((pixels >= low) & (pixels <= high)).all(axis=1))


def to_pixels(intrinsics: Intrinsics, normalised: Array) -> Array:
    """Pixels (N,2) of distorted normalised coordinates (N,2)."""
    scale, centre = (intrinsics.fx, intrinsics.fy), (intrinsics.cx, intrinsics.cy)
    return np.asarray(normalised * scale + centre)


def from_pixels(intrinsics: Intrinsics, pixels: Array) -> Array:
    """Distorted normalised coordinates (..., 2) of pixels (..., 2): (u − cx)/fx, (v − cy)/fy."""
    scale, centre = (intrinsics.fx, intrinsics.fy), (intrinsics.cx, intrinsics.cy)
    return np.asarray((pixels - np.array(centre)) / scale)


def _distort(intrinsics: Intrinsics, normalised: Array) -> Array:
    if not any(intrinsics.dist):
        return normalised
    k1, k2, p1, p2, k3 = intrinsics.dist
    x, y = normalised[:, 0], normalised[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=1,
    )


def _distort_jacobian(intrinsics: Intrinsics, normalised: Array) -> Array:
    k1, k2, p1, p2, k3 = intrinsics.dist
    x, y = normalised[:, 0], normalised[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))  # d radial / d r2, times 2
    out = np.empty((len(normalised), 2, 2))
    out[:, 0, 0] = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    out[:, 0, 1] = out[:, 1, 0] = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    out[:, 1, 1] = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return out


def _solve_2x2(A: Array, b: Array) -> Array:
    determinant = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    x = (A[:, 1, 1] * b[:, 0] - A[:, 0, 1] * b[:, 1]) / determinant
    y = (A[:, 0, 0] * b[:, 1] - A[:, 1, 0] * b[:, 0]) / determinant
    return np.stack([x, y], axis=1)
