"""Where a camera is that was moved far: the room as it saw it, found again in what it sees now."""

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.drift.look import Look, full_pixels
from rig_calib.drift.reference import Reference
from rig_calib.projection import undistort_pixels
from rig_protocol.poses import inverse, se3_log, so3_exp

Array = npt.NDArray[np.float64]

_RATIO = 0.8  # nearest over second-nearest descriptor
_MAX_ERROR_PX, _ROUNDS = 4.0, 300
_MIN_MATCHES = 15


def relocate(reference: Reference, look: Look) -> Array | None:
    """Motion (6,) of the camera since the reference; None when too little is recognised.

    SIFT matches with the reference's depth, and a pose from them by RANSAC, seeded by OpenCV.
    """
    sift = cv2.SIFT.create()
    places, descriptors = sift.detectAndCompute(reference.look.contrast, None)
    now, others = sift.detectAndCompute(look.contrast, None)
    if len(places) < _MIN_MATCHES or len(now) < _MIN_MATCHES:
        return None
    pairs = cv2.BFMatcher().knnMatch(descriptors, others, k=2)
    good = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < _RATIO * pair[1].distance]
    before = np.array([places[match.queryIdx].pt for match in good]).reshape(-1, 2)
    after = np.array([now[match.trainIdx].pt for match in good]).reshape(-1, 2)
    at = np.rint(before).astype(np.intp)
    z = reference.depth_m[at[:, 1].clip(0, reference.depth_m.shape[0] - 1), at[:, 0]].astype(np.float64)
    known = np.isfinite(z)
    return _pose(reference, before[known], z[known], after[known]) if known.sum() >= _MIN_MATCHES else None


def _pose(reference: Reference, before: Array, z: Array, after: Array) -> Array | None:
    color = reference.known.model.color
    points = np.column_stack([undistort_pixels(color, full_pixels(before)) * z[:, None], z])
    seen = undistort_pixels(color, full_pixels(after))
    found, rotation, translation, agreeing = cv2.solvePnPRansac(
        points,
        seen,
        np.eye(3),
        None,
        iterationsCount=_ROUNDS,
        reprojectionError=_MAX_ERROR_PX / color.fx,
        flags=cv2.SOLVEPNP_ITERATIVE,
    )
    if not found or agreeing is None or len(agreeing) < _MIN_MATCHES:
        return None
    T_now_before = np.eye(4)
    T_now_before[:3, :3], T_now_before[:3, 3] = (
        so3_exp(rotation.ravel().astype(np.float64)),
        translation.ravel(),
    )
    return se3_log(inverse(T_now_before))
