"""Looks of the rig's frames."""

import numpy as np

from rig_calib.depth_model import depth_grid, disparity_of_depth
from rig_calib.drift.look import Disparity, Look, known_disparity, look_at
from rig_protocol.camera import CameraModel
from rig_protocol.errors import DataError
from rig_protocol.frames import NO_DEPTH_MM, RgbdFrame


def look_of_frame(model: CameraModel, frame: RgbdFrame | None) -> Look | None:
    """The look of a frame; None when it is missing or damaged, has no depth, or does not fit the model."""
    if frame is None or frame.damaged:
        return None
    color = frame.color if frame.color is not None else frame.bayer
    disparity = _disparity(model, frame)
    if color is None or disparity is None or color.shape[:2] != (model.color.height, model.color.width):
        return None
    return look_at(color, disparity)


def _disparity(model: CameraModel, frame: RgbdFrame) -> Disparity | None:
    try:
        grid = depth_grid(model, frame.depth_frame)
    except DataError:
        return None
    image = frame.raw if frame.raw is not None else frame.depth_mm
    if image is None or image.shape != (grid.intrinsics.height, grid.intrinsics.width):
        return None
    if frame.raw is not None:
        return known_disparity(frame.raw)
    depth_m = np.where(image == NO_DEPTH_MM, np.inf, image * 1e-3)
    disparity = disparity_of_depth(grid.raw_model, depth_m)
    return np.where(np.isfinite(depth_m), np.maximum(disparity, 0), 0).astype(np.float32)
