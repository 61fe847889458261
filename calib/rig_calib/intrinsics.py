"""`rig-calib intrinsics`: one unit measured with a checkerboard, its depth camera by infrared images."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.camera_intrinsics import MIN_VIEWS, IntrinsicsEstimate, calibrate_intrinsics
from rig_calib.checkerboard import Board
from rig_protocol.camera import CameraModel, Intrinsics
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose

Array = npt.NDArray[np.float64]

_MIN_TILT_DEG = 12.0  # boards all more parallel than this leave focal length and distance undecided
_MAX_VIEW_ERROR_PX, _MAX_VIEW_RATIO = (
    1.0,
    3.0,
)  # a view worse than both (times the median) holds a false board
_MIN_COVERAGE = 0.3  # of the image; below, distortion at the border is extrapolated
_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
# The depth image is the infrared image without the border of the correlation window (kinect.md: about
# 5 and 4 px), so that its principal point lies nearer to the corner.
_IR_TO_DEPTH_PX = (5.0, 4.0)
_IR_ROWS = 488  # the infrared stream has eight rows more than the depth image


@dataclass(frozen=True, slots=True, eq=False)
class UnitEstimate:
    """What was measured of one unit: its model, and the estimates behind it."""

    model: CameraModel
    color: IntrinsicsEstimate
    infrared: IntrinsicsEstimate | None
    stereo_rms_px: float | None

    def to_dict(self) -> dict[str, Any]:
        """The intrinsics file: `CameraModel.to_dict()`, and under `measured` how well it is known."""
        measured = {"color": _quality(self.color)}
        if self.infrared is not None:
            measured["infrared"] = _quality(self.infrared)
            measured["stereo"] = {"rms_px": self.stereo_rms_px}
        return {**self.model.to_dict(), "measured": measured}


def run(
    image_files: Sequence[Path],
    board: Board,
    out: Path,
    ir_files: Sequence[Path] = (),
    known: CameraModel | None = None,
) -> UnitEstimate:
    """`rig-calib intrinsics`: measure one unit from image files and write its intrinsics file.

    `ir_files` are infrared images of the same boards, in the same order. What the images do not show is
    taken from `known`. ConfigurationError and DataError say which image is at fault.
    """
    if ir_files and len(ir_files) != len(image_files):
        raise ConfigurationError(
            f"{len(image_files)} colour and {len(ir_files)} infrared images: each board needs one of both"
        )
    colors = {str(path): _read_image(path) for path in image_files}
    infrareds = {str(path): _read_image(path) for path in ir_files}
    estimate = calibrate_unit(colors, board, infrareds, known)
    out.write_text(json.dumps(estimate.to_dict(), indent=1) + "\n")
    return estimate


def calibrate_unit(
    colors: Mapping[str, ImageU8],
    board: Board,
    infrareds: Mapping[str, ImageU8] | None = None,
    known: CameraModel | None = None,
) -> UnitEstimate:
    """Colour intrinsics; with infrared images also the depth camera's and T_color_depth.

    Infrared images show the same boards in the same order. The rest is that of `known` (default: a
    typical unit). DataError as `calibrate_intrinsics`.
    """
    model = replace(known or CameraModel(), source="file")
    color = calibrate_intrinsics(colors, board)
    model = replace(model, color=color.intrinsics)
    if not infrareds:
        return UnitEstimate(model, color, None, None)
    infrared = calibrate_intrinsics(infrareds, board)
    T_color_depth, rms_px = _stereo(colors, infrareds, board, color, infrared)
    model = replace(model, depth=_depth_grid(infrared.intrinsics), T_color_depth=T_color_depth)
    return UnitEstimate(model, color, infrared, rms_px)


def _stereo(
    colors: Mapping[str, ImageU8],
    infrareds: Mapping[str, ImageU8],
    board: Board,
    color: IntrinsicsEstimate,
    infrared: IntrinsicsEstimate,
) -> tuple[Pose, float]:
    """T_color_depth from the boards that both cameras show, and its rms error."""
    pairs = [
        (board.find(colors[c]), board.find(infrareds[i]))
        for c, i in zip(colors, infrareds, strict=True)
        if c in color.views and i in infrared.views
    ]
    both = [(c, _same_order(c, i)) for c, i in pairs if c is not None and i is not None]
    if len(both) < MIN_VIEWS:
        raise DataError(
            f"only {len(both)} boards are seen by colour and infrared alike, {MIN_VIEWS} are needed: "
            "hold the board where both cameras see all of it"
        )
    size = (color.intrinsics.width, color.intrinsics.height)
    rms, *_, R, t, _, _ = cv2.stereoCalibrate(
        [board.corners_m().astype(np.float32)] * len(both),
        [i.astype(np.float32) for _, i in both],
        [c.astype(np.float32) for c, _ in both],
        *_matrices(infrared.intrinsics),
        *_matrices(color.intrinsics),
        size,
        flags=cv2.CALIB_FIX_INTRINSIC,
    )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, np.ravel(t)
    return T, float(rms)


def _same_order(reference: Array, corners: Array) -> Array:
    """The corners in the order of the other camera's, which looks the same way: a board has two ends."""
    along = (reference[-1] - reference[0]) @ (corners[-1] - corners[0])
    return corners if along > 0 else corners[::-1]


def _depth_grid(infrared: Intrinsics) -> Intrinsics:
    """Intrinsics of the depth image, whose grid is that of the infrared image moved by a few pixels."""
    height = infrared.height - 8 if infrared.height == _IR_ROWS else infrared.height
    dx, dy = _IR_TO_DEPTH_PX
    return replace(infrared, cx=infrared.cx - dx, cy=infrared.cy - dy, height=height)


def _matrices(intrinsics: Intrinsics) -> tuple[Array, Array]:
    K = np.array([[intrinsics.fx, 0, intrinsics.cx], [0, intrinsics.fy, intrinsics.cy], [0, 0, 1]])
    return K, np.array(intrinsics.dist)


def _quality(estimate: IntrinsicsEstimate) -> dict[str, Any]:
    return {
        "rms_px": estimate.rms_px,
        "sigma": dict(estimate.sigma),
        "images": len(estimate.views),
        "rejected": dict(estimate.rejected),
        "warnings": list(estimate.warnings),
    }


def _read_image(path: Path) -> ImageU8:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if image is None:
        raise ConfigurationError(f"{path} is not a readable image")
    if image.dtype != np.uint8:  # 10-bit infrared comes as 16-bit PNG
        image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX, dtype=cv2.CV_8U)  # type: ignore[call-overload]
    return np.ascontiguousarray(image[..., :3] if image.ndim == 3 else image, dtype=np.uint8)
