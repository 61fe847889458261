"""Where a camera is that looks at the room from elsewhere: what was seen before, found again in its image."""

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.drift.look import full_pixels
from rig_calib.drift.reference import Reference
from rig_calib.projection import undistort_pixels
from rig_protocol.camera import Intrinsics
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose, so3_exp

Array = npt.NDArray[np.float64]

_RATIO = 0.8  # nearest over second-nearest descriptor
_MAX_ERROR_PX, _ROUNDS = 4.0, 300
_MIN_MATCHES = 15


def relocate(reference: Reference, contrast: ImageU8, color: Intrinsics) -> Pose | None:
    """T_now_reference of the camera that sees `contrast`; None when it recognises too little.

    SIFT matches with the reference's depth, and a pose from them by RANSAC, which OpenCV seeds.
    """
    sift = cv2.SIFT.create()
    places, descriptors = sift.detectAndCompute(reference.look.contrast, None)
    now, others = sift.detectAndCompute(contrast, None)
    if len(places) < _MIN_MATCHES or len(now) < _MIN_MATCHES:
        return None
    pairs = cv2.BFMatcher().knnMatch(descriptors, others, k=2)
    good = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < _RATIO * pair[1].distance]
    before = np.array([places[match.queryIdx].pt for match in good]).reshape(-1, 2)
    after = np.array([now[match.trainIdx].pt for match in good]).reshape(-1, 2)
    rows, columns = np.rint(before[:, 1]).astype(np.intp), np.rint(before[:, 0]).astype(np.intp)
    size = reference.depth_m.shape
    z = reference.depth_m[rows.clip(0, size[0] - 1), columns.clip(0, size[1] - 1)].astype(np.float64)
    known = np.isfinite(z)
    if known.sum() < _MIN_MATCHES:
        return None
    rays = undistort_pixels(reference.known.model.color, full_pixels(before[known]))
    points = np.column_stack([rays * z[known, None], z[known]])
    return _pose(points, undistort_pixels(color, full_pixels(after[known])), _MAX_ERROR_PX / color.fx)


def _pose(points: Array, seen: Array, max_error: float) -> Pose | None:
    """The pose from which points (N,3) are seen on rays (N,2), if enough of them agree."""
    found, rotation, translation, agreeing = cv2.solvePnPRansac(
        points,
        seen,
        np.eye(3),
        None,
        iterationsCount=_ROUNDS,
        reprojectionError=max_error,
        flags=cv2.SOLVEPNP_ITERATIVE,
    )
    if not found or agreeing is None or len(agreeing) < _MIN_MATCHES:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3_exp(rotation.ravel().astype(np.float64)), translation.ravel()
    return T
