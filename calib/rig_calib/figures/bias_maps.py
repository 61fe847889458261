"""Bias maps: what each camera's depth correction does over its image, in millimetres at one distance."""

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DepthCorrection, DepthGrid, depth_grid
from rig_calib.evidence import EdgeEvidence
from rig_calib.figures.case import ReportCase
from rig_calib.figures.charts import nice_ceiling
from rig_calib.figures.page import Figure
from rig_calib.figures.pictures import upright, upright_pixels
from rig_calib.projection import from_pixels, project, undistort_pixels
from rig_calib.view import CameraView
from rig_protocol.camera import Intrinsics
from rig_protocol.frames import ImageU8
from rig_protocol.poses import inverse, transform_points

Array = npt.NDArray[np.float64]

MAP_DISTANCE_M = 1.5
_STEP_PX = 16  # the correction is a low-order polynomial: a coarse grid holds all of it
_BANDS = 20  # of one colour each, so that they read like contour lines
# Takes away, nothing, adds; BGR.
_SCALE = ((172, 97, 33), (247, 247, 247), (24, 90, 200))
_DOT = (40, 40, 40)


def bias_maps(case: ReportCase) -> tuple[list[Figure], float]:
    """A map of every camera that has a correction, all on one scale, which ends at ± so many millimetres."""
    known = [
        (case.view(camera.id), bias_map_mm(case.view(camera.id), camera.depth_correction))
        for camera in case.calibration.cameras
        if camera.depth_correction is not None and camera.id in case.names
    ]
    limit_mm = nice_ceiling(max((float(np.abs(bias).max()) for _, bias in known), default=1.0))
    portrait = case.viewpoint is not None and case.viewpoint.portrait
    figures = [
        Figure.drawing(
            _picture(bias, limit_mm, view.model.color, _matched(view.camera_id, case.evidence), portrait),
            f"Depth correction of {view.name} over its image",
            f"{view.name}: {bias.min():+z.0f} to {bias.max():+z.0f} mm",
        )
        for view, bias in known
    ]
    return figures, limit_mm


def bias_map_mm(view: CameraView, correction: DepthCorrection) -> Array:
    """Millimetres (h,w) that the correction adds at `MAP_DISTANCE_M`, on a coarse grid of the image."""
    color, grid = view.model.color, depth_grid(view.model, view.depth_frame)
    columns = np.linspace(0, color.width - 1, color.width // _STEP_PX + 1)
    rows = np.linspace(0, color.height - 1, color.height // _STEP_PX + 1)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    factor = correction.factor(*_on_grid(color, grid, pixels).T)
    return np.asarray(((factor - 1.0) * MAP_DISTANCE_M * 1e3).reshape(len(rows), len(columns)))


def _on_grid(color: Intrinsics, grid: DepthGrid, pixels: Array) -> Array:
    """Normalised coordinates (N,2) on the depth grid of what colour pixels (N,2) see at the distance."""
    rays = np.column_stack([np.nan_to_num(undistort_pixels(color, pixels)), np.ones(len(pixels))])
    points = transform_points(inverse(grid.T_color_grid), rays * MAP_DISTANCE_M)
    return from_pixels(grid.intrinsics, project(grid.intrinsics, points))


def _matched(camera_id: int, evidence: Sequence[EdgeEvidence]) -> Array:
    """Pixels (N,2) of the camera's kept matches: where the map rests on measurements."""
    parts = [item.pixels_i[item.inlier] for item in evidence if item.i == camera_id]
    parts += [item.pixels_j[item.inlier] for item in evidence if item.j == camera_id]
    return np.concatenate([np.empty((0, 2)), *parts])


def _picture(bias: Array, limit_mm: float, color: Intrinsics, matched: Array, portrait: bool) -> ImageU8:
    size = color.width // 2, color.height // 2
    smooth = cv2.resize(bias, size, interpolation=cv2.INTER_CUBIC)
    image = _colored(np.asarray(smooth, dtype=np.float64) / limit_mm)
    image = np.ascontiguousarray(upright(image, portrait))
    half = np.zeros((size[1], size[0]), np.uint8)
    for x, y in np.rint(upright_pixels(matched / 2, half, portrait)).astype(int).tolist():
        cv2.circle(image, (x, y), 1, _DOT, -1)
    return image


def _colored(values: Array) -> ImageU8:
    """BGR (H,W,3) of −1 to 1, in bands."""
    bands = np.clip(np.rint(values * _BANDS / 2) / (_BANDS / 2), -1.0, 1.0)
    low, middle, high = (np.array(color, dtype=np.float64) for color in _SCALE)
    share = np.abs(bands)[..., None]
    ends = np.where(bands[..., None] < 0, low, high)
    return np.rint(middle + share * (ends - middle)).astype(np.uint8)
