"""ObservedCamera: a camera's keypoints with their depth, all that the later stages need of its images."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DepthGrid, depth_grid, disparity_image
from rig_calib.features import Keypoints, detect, detect_coarsely, mean_grey
from rig_calib.keypoint_depth import KeypointDepth, keypoint_depth, keypoint_points, mean_disparity
from rig_calib.overlap import Region
from rig_calib.patch_alignment import ImageF32, smoothed
from rig_calib.registration import Side
from rig_calib.settings import CalibrationSettings
from rig_calib.view import CameraView

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class ObservedCamera:
    """Keypoints of the colour image and, row by row, their depth and their points in the colour camera.

    `image` (H,W) is grey and smoothed, `disparity` (H,W) is the grid's; both are means over the frames.
    """

    view: CameraView
    grid: DepthGrid
    image: ImageF32
    disparity: Array
    keypoints: Keypoints
    depth: KeypointDepth
    points: Array

    def side(self, rows: Index) -> Side:
        """What registration needs of the keypoints that the rows name."""
        return Side(self.view.model.color, self.keypoints.pixels[rows], self.points[rows])

    def with_keypoints(self, keypoints: Keypoints) -> "ObservedCamera":
        """The camera with other keypoints, whose depth is looked up."""
        depth = self.depth_at(keypoints.pixels)
        points = keypoint_points(self.view.model.color, self.grid, keypoints.pixels, depth)
        return replace(self, keypoints=keypoints, depth=depth, points=points)

    def depth_at(self, pixels: Array) -> KeypointDepth:
        """Depth at pixels (N,2) of the colour image."""
        return keypoint_depth(self.view.model.color, self.grid, self.disparity, pixels, self.depth_frames)

    @property
    def depth_frames(self) -> int:
        """How many depth images were averaged."""
        return max(len(self.view.raw), len(self.view.depth_mm), 1)


def missing_images(view: CameraView) -> str | None:
    """Why a view cannot be calibrated, or None when it can."""
    return None if view.color else "no colour image"


def observe(view: CameraView, regions: Sequence[Region], settings: CalibrationSettings) -> ObservedCamera:
    """Detect keypoints in regions and look up their depth; all frames of the view are averaged.

    DataError when the depth images do not fit the camera model.
    """
    grid = depth_grid(view.model, view.depth_frame)
    frames = len(view.raw) or len(view.depth_mm)
    images = [disparity_image(view, frame) for frame in range(frames)]
    disparity = mean_disparity(images or [_no_disparity(grid)])
    grey = mean_grey(view.color)
    if settings.method == "paper":
        whole = reduce(Region.union, regions)
        keypoints = detect(grey, whole, settings.max_keypoints, settings.pixel_sigma)
    else:
        keypoints = detect_coarsely(grey, regions, settings.max_keypoints, settings.pixel_sigma)
    depth = keypoint_depth(view.model.color, grid, disparity, keypoints.pixels, max(frames, 1))
    points = keypoint_points(view.model.color, grid, keypoints.pixels, depth)
    return ObservedCamera(view, grid, smoothed(grey), disparity, keypoints, depth, points)


def _no_disparity(grid: DepthGrid) -> Array:
    return np.full((grid.intrinsics.height, grid.intrinsics.width), np.nan)
