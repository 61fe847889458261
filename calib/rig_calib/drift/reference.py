"""Reference: what a camera saw of the still room, from several looks."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DepthCorrection, depth_grid, grid_points
from rig_calib.drift.depth_blocks import DepthBlocks
from rig_calib.drift.landmarks import choose_landmarks, gradient_tensors
from rig_calib.drift.look import HALF, Disparity, Look, Plane, full_pixels, median_look
from rig_calib.drift.motion import pixel_jacobian
from rig_calib.projection import project, undistort_pixels
from rig_protocol.camera import CameraModel
from rig_protocol.frames import DepthFrame
from rig_protocol.poses import inverse, transform_points

Array = npt.NDArray[np.float64]

_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, slots=True, eq=False)
class CameraKnown:
    """What calibration knows of a camera: its model, its depth correction, on which grid its depth is."""

    model: CameraModel
    correction: DepthCorrection | None = None
    depth_frame: DepthFrame = "depth"


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """The still room as one camera sees it.

    `landmarks` (N,2), halved pixels, with gradient `tensors` (N,2,2), `points` (N,3) in the colour camera,
    `jacobian` (N,2,6) and the depth `block` (N,) that each falls on. `depth_m` (h,w): depth along the colour
    camera's axis at halved pixels, infinite where none is known. Noise of one look: `noise_levels` of the
    contrast, `noise_steps` of a block's disparity. `looks`: how many were averaged.
    """

    known: CameraKnown
    look: Look
    blocks: DepthBlocks
    depth_m: Plane
    landmarks: Array
    tensors: Array
    points: Array
    jacobian: Array
    block: npt.NDArray[np.intp]
    noise_levels: float
    noise_steps: float
    looks: int


def learn_reference(known: CameraKnown, looks: Sequence[Look]) -> Reference:
    """The reference that several looks of one camera agree on."""
    look = median_look(looks)
    grid = depth_grid(known.model, known.depth_frame)
    blocks = DepthBlocks.of(look.disparity, grid, known.correction)
    depth_m = color_depth(known, look.disparity)
    landmarks = choose_landmarks(look.contrast, np.isfinite(depth_m))
    z = depth_m[landmarks[:, 1].astype(int), landmarks[:, 0].astype(int)].astype(np.float64)
    rays = undistort_pixels(known.model.color, full_pixels(landmarks))
    points = np.column_stack([rays * z[:, None], z])
    on_grid = project(grid.intrinsics, transform_points(inverse(grid.T_color_grid), points))
    return Reference(
        known,
        look,
        blocks,
        depth_m,
        landmarks,
        gradient_tensors(look.contrast, landmarks),
        points,
        pixel_jacobian(known.model.color, points),
        blocks.at(on_grid),
        *_noise(looks, look, blocks),
        len(looks),
    )


def color_depth(known: CameraKnown, disparity: Disparity) -> Plane:
    """Depth (h,w) at the halved colour pixels; the nearest where several fall on one, infinite where none."""
    color = known.model.color
    size = (color.height // HALF, color.width // HALF)
    rows, columns = np.nonzero(disparity > 0)
    pixels = np.column_stack([columns, rows])
    grid = depth_grid(known.model, known.depth_frame)
    points, _ = grid_points(grid, pixels, disparity[rows, columns].astype(np.float64), known.correction)
    points = points[points[:, 2] > 0.1]
    at = np.rint((project(color, points) - (HALF - 1) / 2) / HALF).astype(np.intp)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < size[1]) & (at[:, 1] < size[0])
    at, z = at[inside], points[inside, 2]
    far_first = np.argsort(-z)
    depth_m = np.full(size, np.inf, np.float32)
    depth_m[at[far_first, 1], at[far_first, 0]] = z[far_first]
    return np.asarray(cv2.erode(depth_m, np.ones((3, 3), np.uint8)), dtype=np.float32)


def _noise(looks: Sequence[Look], still: Look, blocks: DepthBlocks) -> tuple[float, float]:
    """Standard deviations of one look: of the contrast, and of the disparity of a block."""
    levels, steps = [], []
    for look in looks:
        levels.append(np.median(np.abs(look.contrast.astype(np.int16) - still.contrast)))
        changes = blocks.changes(still.disparity, look.disparity)[blocks.flat]
        if np.isfinite(changes).any():
            steps.append(np.nanmedian(np.abs(changes)))
    noise_levels = _MAD_TO_SIGMA * float(np.median(levels)) if levels else 1.0
    return max(noise_levels, 1.0), max(_MAD_TO_SIGMA * float(np.median(steps)) if steps else 1.0, 0.05)
