"""The relative pose of two cameras from matched keypoints with depth.

A seeded RANSAC over three-point alignments (Kabsch 1976) finds the start and the matches that agree; the
paper's estimate (eq. 4, 5) minimises the distances between the 3D points.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.agreement import Limits, agreement
from rig_calib.observation_model import intrinsics_row
from rig_calib.projection import undistort_pixels
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import Pose, hat, inverse, se3_exp, transform_points

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

# Hypotheses scored at once: fewer at first, since most matches of a good pair are true. More than one clean
# sample is wanted: the best of some dozens starts nearer.
_FIRST_BATCH, _LARGEST_BATCH = 128, 256
_MAX_TRIALS = 4096
_CONFIDENCE = 0.9999
_POLISH_ROUNDS = 4
_LEAST_RESECTION, _RESECTION_TRIALS = 6, 1000
_MIN_SAMPLE_SIDE_M = 0.1  # closer points turn noise into rotation
_GAUSS_NEWTON_STEPS = 20


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """One camera's part of N matches: pixels (N,2), points (N,3) in its colour camera, NaN = no depth."""

    color: Intrinsics
    pixels: Array
    points: Array

    @property
    def known(self) -> Mask:
        """(N,) where the match has depth in this camera."""
        return np.asarray(np.isfinite(self.points[:, 2]))


@dataclass(frozen=True, slots=True)
class Tolerance:
    """When a match agrees with a pose: distance in the image, and in depth.

    Depth is compared in inverse metres, where the sensor's noise is the same at every distance; a unit's own
    depth scale may be off by a share of it.
    """

    pixels: float = 6.0
    inverse_depth: float = 0.012  # eight raw steps of noise and of smooth distortion
    depth_scale: float = 0.03


def agreeing(T_i_j: Pose, i: Side, j: Side, tolerance: Tolerance) -> Mask:
    """(N,) the matches that a pose explains, by every measurement they have; False without any depth."""
    return np.asarray(_agreeing_all(T_i_j[None], i, j, tolerance)[0])


def ransac(
    i: Side, j: Side, tolerance: Tolerance, rng: np.random.Generator, min_inliers: int
) -> tuple[Pose, Mask] | None:
    """T_i_j and the matches that agree with it, or None when fewer than `min_inliers` do.

    Where only one of the cameras has depth, its points are held against the other's pixels.
    """
    both = np.flatnonzero(i.known & j.known)
    if len(both) < 3:
        return _resection(i, j, tolerance, min_inliers)
    best, best_count, tried, batch = np.eye(4), 0, 0, _FIRST_BATCH
    while tried < min(_MAX_TRIALS, _trials_needed(best_count / len(i.pixels))):
        samples = _triples(both, batch, rng)
        tried, batch = tried + batch, min(2 * batch, _LARGEST_BATCH)
        samples = samples[_plausible(i.points[samples], j.points[samples], tolerance)]
        if len(samples):
            poses = align_batch(i.points[samples], j.points[samples])
            counts = _agreeing_all(poses, i, j, tolerance).sum(axis=1)
            if counts.max() > best_count:
                best, best_count = poses[counts.argmax()], int(counts.max())
    return _polish(best, i, j, tolerance, min_inliers)


def _resection(i: Side, j: Side, tolerance: Tolerance, min_inliers: int) -> tuple[Pose, Mask] | None:
    """As `ransac`, from the points of the camera that has more of them and the pixels of the other."""
    turned = int(j.known.sum()) > int(i.known.sum())
    source, target = (j, i) if turned else (i, j)
    rows = np.flatnonzero(source.known)
    if len(rows) < max(min_inliers, _LEAST_RESECTION):
        return None
    focal = target.color.fx
    found, turn, shift, _ = cv2.solvePnPRansac(
        source.points[rows],
        undistort_pixels(target.color, target.pixels[rows]) * focal,
        np.diag([focal, focal, 1.0]),
        None,
        iterationsCount=_RESECTION_TRIALS,
        reprojectionError=tolerance.pixels,
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found:
        return None
    T_target_source = np.eye(4)
    T_target_source[:3, :3], T_target_source[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    pose = T_target_source if turned else inverse(T_target_source)
    inlier = agreeing(pose, i, j, tolerance)
    return (pose, inlier) if inlier.sum() >= min_inliers else None


def align(p_i: Array, p_j: Array, weights: Array | None = None) -> Pose:
    """T_i_j that minimises Σ w ‖p_i − T_i_j p_j‖² over points (N,3) (Kabsch 1976)."""
    weights = np.ones(len(p_i)) if weights is None else weights
    share = (weights / weights.sum())[:, None]
    mean_i, mean_j = (share * p_i).sum(axis=0), (share * p_j).sum(axis=0)
    return _kabsch(((p_i - mean_i) * share).T @ (p_j - mean_j), mean_i, mean_j)


def align_batch(p_i: Array, p_j: Array) -> Array:
    """T_i_j (B,4,4) of B sets of points (B,N,3)."""
    mean_i, mean_j = p_i.mean(axis=1), p_j.mean(axis=1)
    covariance = np.einsum("bni,bnj->bij", p_i - mean_i[:, None], p_j - mean_j[:, None])
    return _kabsch(covariance, mean_i, mean_j)


def minimise_distances(p_i: Array, p_j: Array, start: Pose) -> tuple[Pose, Array]:
    """The paper's estimate of T_i_j from points (N,3), and its normal matrix (6,6), rotation first.

    Gauss-Newton on eq. 4 with the left perturbation of eq. 5.
    """
    T, normal = start, np.zeros((6, 6))
    for _ in range(_GAUSS_NEWTON_STEPS):
        moved = transform_points(T, p_j)
        J = np.concatenate([-hat(moved), np.broadcast_to(np.eye(3), (len(moved), 3, 3))], axis=2)
        normal = np.einsum("nki,nkj->ij", J, J)
        step = np.linalg.lstsq(normal, np.einsum("nki,nk->i", J, p_i - moved), rcond=None)[0]
        T = se3_exp(step) @ T
        if np.abs(step).max() < 1e-12:
            break
    return T, normal


def _kabsch(covariance: Array, mean_i: Array, mean_j: Array) -> Array:
    U, _, Vt = np.linalg.svd(covariance)
    mirrored = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    U = U.copy()
    U[..., :, 2] *= np.where(mirrored == 0, 1.0, mirrored)[..., None]
    T = np.zeros((*covariance.shape[:-2], 4, 4))
    T[..., :3, :3] = U @ Vt
    T[..., :3, 3] = mean_i - np.einsum("...ij,...j->...i", T[..., :3, :3], mean_j)
    T[..., 3, 3] = 1.0
    return T


def _triples(rows: npt.NDArray[np.intp], count: int, rng: np.random.Generator) -> npt.NDArray[np.intp]:
    """Random triples (count,3) of different rows."""
    if len(rows) == 3:
        return rows[None]
    return np.asarray(rows[rng.random((count, len(rows))).argpartition(2, axis=1)[:, :3]])


def _plausible(p_i: Array, p_j: Array, tolerance: Tolerance) -> Mask:
    """Samples (B,3,3) whose triangles have sides of one length in both cameras, and none too short."""
    sides_i, sides_j = (np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2) for p in (p_i, p_j))
    depth = np.maximum(p_i[..., 2].max(axis=1), p_j[..., 2].max(axis=1))[:, None]
    allowed = 2.0 * tolerance.depth_scale * np.maximum(sides_i, sides_j) + tolerance.inverse_depth * depth**2
    alike = (np.abs(sides_i - sides_j) < allowed + 0.02).all(axis=1)
    return np.asarray(alike & (np.minimum(sides_i, sides_j) > _MIN_SAMPLE_SIDE_M).all(axis=1))


def _agreeing_all(poses: Array, i: Side, j: Side, tolerance: Tolerance) -> Mask:
    """(B,N) for poses T_i_j (B,4,4)."""
    camera_i, camera_j = (np.array([intrinsics_row(side.color)]) for side in (i, j))
    limits = Limits(tolerance.pixels**2, tolerance.inverse_depth, tolerance.depth_scale)
    arrays = map(np.ascontiguousarray, (poses, camera_i, i.pixels, i.points, camera_j, j.pixels, j.points))
    return agreement(limits, *arrays)


def _polish(pose: Pose, i: Side, j: Side, tolerance: Tolerance, min_inliers: int) -> tuple[Pose, Mask] | None:
    both = i.known & j.known
    inlier = agreeing(pose, i, j, tolerance)
    for _ in range(_POLISH_ROUNDS):
        if (inlier & both).sum() < 3:
            return None
        use = inlier & both
        # Depth noise grows with the square of the distance.
        pose = align(i.points[use], j.points[use], 1.0 / np.maximum(i.points[use, 2], j.points[use, 2]) ** 4)
        inlier = agreeing(pose, i, j, tolerance)
    return (pose, inlier) if inlier.sum() >= min_inliers and (inlier & both).sum() >= 3 else None


def _trials_needed(share: float) -> float:
    """How many samples of three until one is clean with the wanted confidence."""
    clean = share**3
    if clean <= 1e-9:
        return np.inf
    return 1.0 if clean >= 1.0 - 1e-12 else float(np.log(1.0 - _CONFIDENCE) / np.log1p(-clean))
