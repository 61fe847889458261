"""Intrinsics of one camera from images of a checkerboard.

Method: Zhang, A Flexible New Technique for Camera Calibration, 2000, as OpenCV implements it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.checkerboard import Board
from rig_protocol.camera import Intrinsics
from rig_protocol.errors import DataError
from rig_protocol.frames import ImageU8

Array = npt.NDArray[np.float64]

MIN_VIEWS = 5
"""Boards in different positions that a calibration needs; ten or more are better."""

_MIN_TILT_DEG = 12.0  # boards all more parallel than this leave focal length and distance undecided
_MAX_VIEW_RMS_PX, _MAX_VIEW_RATIO = 1.0, 3.0  # a view worse than both (times the median) shows no board
_MIN_COVERAGE = 0.3  # of the image; below, distortion at the border is extrapolated
_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True, slots=True, eq=False)
class IntrinsicsEstimate:
    """Intrinsics with their standard deviations by parameter, and how well they explain the corners.

    `views` are the names of the images used; `rejected` says by name why another was not.
    """

    intrinsics: Intrinsics
    sigma: Mapping[str, float]
    rms_px: float
    views: tuple[str, ...]
    rejected: Mapping[str, str]
    warnings: tuple[str, ...]


def calibrate_intrinsics(images: Mapping[str, ImageU8], board: Board) -> IntrinsicsEstimate:
    """Intrinsics of one camera from images (by name) of a board.

    DataError: images of different size, a board found in fewer than five (all names listed), or all
    boards nearly parallel.
    """
    size = _common_size(images)
    found = {name: board.find(image) for name, image in images.items()}
    corners = {name: points for name, points in found.items() if points is not None}
    rejected = {name: "no board found" for name, points in found.items() if points is None}
    _require_views(corners, rejected, board)
    solution = _solve(corners, board, size)
    worst = max(_MAX_VIEW_RMS_PX, _MAX_VIEW_RATIO * float(np.median(solution.view_rms_px)))
    for name, rms_px in zip(list(corners), solution.view_rms_px, strict=True):
        if rms_px > worst:
            rejected[name] = f"does not fit the others ({rms_px:.1f} px)"
            del corners[name]
    if len(corners) < len(solution.view_rms_px):
        _require_views(corners, rejected, board)
        solution = _solve(corners, board, size)
    _require_tilt(solution.rotations)
    return IntrinsicsEstimate(
        intrinsics=solution.intrinsics(size),
        sigma=dict(zip(_PARAMETERS, solution.sigmas, strict=True)),
        rms_px=solution.rms_px,
        views=tuple(corners),
        rejected=rejected,
        warnings=_coverage_warnings(corners, size),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    values: tuple[float, ...]
    sigmas: tuple[float, ...]
    rms_px: float
    view_rms_px: Array
    rotations: Array

    def intrinsics(self, size: tuple[int, int]) -> Intrinsics:
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = self.values
        return Intrinsics(fx, fy, cx, cy, size[0], size[1], (k1, k2, p1, p2, k3))


def _solve(corners: Mapping[str, Array], board: Board, size: tuple[int, int]) -> _Solution:
    """All nine parameters; k3 is left at zero where the images do not tell it from zero."""
    solution = _solve_with(corners, board, size, 0)
    if abs(solution.values[8]) > 2 * solution.sigmas[8]:
        return solution
    return _solve_with(corners, board, size, cv2.CALIB_FIX_K3)


def _solve_with(corners: Mapping[str, Array], board: Board, size: tuple[int, int], flags: int) -> _Solution:
    on_board = [board.corners_m().astype(np.float32)] * len(corners)
    in_images = [points.astype(np.float32) for points in corners.values()]
    rms, K, dist, turns, _, sigma, _, view_rms = cv2.calibrateCameraExtended(
        on_board, in_images, size, np.eye(3), np.zeros(5), flags=flags
    )
    values = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.ravel(dist)[:5])
    return _Solution(
        values=tuple(float(value) for value in values),
        sigmas=tuple(float(value) for value in np.ravel(sigma)[:9]),
        rms_px=float(rms),
        view_rms_px=np.ravel(view_rms),
        rotations=np.array([cv2.Rodrigues(turn)[0] for turn in turns]),
    )


def _common_size(images: Mapping[str, ImageU8]) -> tuple[int, int]:
    sizes = {name: (image.shape[1], image.shape[0]) for name, image in images.items()}
    if len(set(sizes.values())) > 1:
        listed = ", ".join(f"{name} {w}×{h}" for name, (w, h) in sizes.items())
        raise DataError(f"the images differ in size: {listed}")
    return next(iter(sizes.values()), (0, 0))


def _require_views(corners: Mapping[str, Array], rejected: Mapping[str, str], board: Board) -> None:
    if len(corners) >= MIN_VIEWS:
        return
    reasons = "".join(f"\n  {name}: {reason}" for name, reason in rejected.items())
    raise DataError(
        f"{len(corners)} usable images of a board with {board.columns}×{board.rows} inner corners, "
        f"{MIN_VIEWS} are needed (ten or more are better); the whole board must be in sharp view{reasons}"
    )


def _require_tilt(rotations: Array) -> None:
    normals = rotations[:, :, 2]
    cosines = [abs(float(normals[a] @ normals[b])) for a, b in combinations(range(len(normals)), 2)]
    tilt = np.rad2deg(np.arccos(np.clip(min(cosines), -1, 1)))
    if tilt < _MIN_TILT_DEG:
        raise DataError(
            f"all boards are nearly parallel ({tilt:.0f}° at most, {_MIN_TILT_DEG:.0f}° are needed): tilt "
            "the board by 20° to 40° to all sides, else focal length and distance cannot be told apart"
        )


def _coverage_warnings(corners: Mapping[str, Array], size: tuple[int, int]) -> tuple[str, ...]:
    hull = cv2.convexHull(np.concatenate(list(corners.values())).astype(np.float32))
    share = cv2.contourArea(hull) / (size[0] * size[1])
    if share >= _MIN_COVERAGE:
        return ()
    return (f"the boards cover {100 * share:.0f} % of the image: show them near its corners too",)
