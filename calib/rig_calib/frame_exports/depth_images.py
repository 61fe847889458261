"""Depth images as other programs expect them: distance along the axis, corrected, 0 where there is none."""

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import (
    DepthCorrection,
    depth_grid,
    depth_of_disparity,
    depth_points,
    disparity_image,
)
from rig_calib.fusion.visibility import in_field
from rig_calib.projection import from_pixels, inside
from rig_calib.view import CameraView
from rig_protocol.camera import Intrinsics
from rig_protocol.frames import ImageU16

Array = npt.NDArray[np.float64]


def has_depth(view: CameraView) -> bool:
    """Whether its first frame came with a depth image."""
    return bool(view.raw or view.depth_mm)


def depth_image(view: CameraView, correction: DepthCorrection | None, units_per_m: float) -> ImageU16:
    """Depth (H,W) of the view's first frame on its own grid; 0 where there is none or it is out of 0.4–8 m.

    DataError when the model lacks the depth camera, or the image is not of its size.
    """
    grid = depth_grid(view.model, view.depth_frame)
    depth_m = depth_of_disparity(grid.raw_model, disparity_image(view, 0))
    if correction is not None:
        depth_m = depth_m * _factors(grid.intrinsics, correction)
    return _as_units(depth_m, units_per_m)


def registered_depth_image(
    view: CameraView, correction: DepthCorrection | None, units_per_m: float
) -> ImageU16:
    """As `depth_image`, seen by the colour camera: every measured point in the colour pixel it falls on.

    The nearest point of a pixel counts. Nothing is filled in: a Kinect's colour pixels are wider than those
    of its depth, so that hardly any stays empty on a surface.
    """
    points = depth_points(view, 0, correction)
    color = view.model.color
    seen = in_field(color, points.points_m) & inside(color, points.color_pixels)
    columns, rows = np.rint(points.color_pixels[seen]).astype(np.intp).T
    nearest = np.full((color.height, color.width), np.inf)
    place = rows.clip(0, color.height - 1), columns.clip(0, color.width - 1)
    np.minimum.at(nearest, place, points.points_m[seen, 2])
    return _as_units(nearest, units_per_m)


def _as_units(depth_m: Array, units_per_m: float) -> ImageU16:
    units = np.where(np.isfinite(depth_m), depth_m, 0.0) * units_per_m
    return np.asarray(np.rint(units.clip(0, np.iinfo(np.uint16).max)), dtype=np.uint16)


@lru_cache(maxsize=16)  # one a camera of the rig and some to spare; 2.5 MB each
def _factors(intrinsics: Intrinsics, correction: DepthCorrection) -> Array:
    """What the correction multiplies every pixel's depth (H,W) by."""
    v, u = np.mgrid[: intrinsics.height, : intrinsics.width].astype(np.float64)
    x, y = np.moveaxis(from_pixels(intrinsics, np.stack([u, v], axis=-1)), -1, 0)
    factors = correction.factor(x, y)
    factors.flags.writeable = False
    return factors
