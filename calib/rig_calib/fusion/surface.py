"""Surface: what one camera contributes to a fused result, cleaned, with colour and noise of each point."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import (
    DepthCorrection,
    DepthGrid,
    depth_grid,
    depth_sigma_m,
    disparity_image,
    grid_points,
)
from rig_calib.fusion.cleaning import Mask, cos_incidence, mean_disparity, smooth_disparity, solid_pixels
from rig_calib.fusion.sampling import mean_color, sample_colors
from rig_calib.fusion.visibility import seen_in_color
from rig_calib.rig_calibration import RigCalibration
from rig_calib.view import CameraView
from rig_protocol.errors import DataError
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose, transform_points

Array = npt.NDArray[np.float64]
Array32 = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Points (N,3) of one camera in its colour camera frame, with `sigma_m` (N,) and `colors` (N,3) RGB."""

    camera_id: int
    name: str
    points_m: Array32
    sigma_m: Array32
    colors: ImageU8

    def points_at(self, T_rig_camera: Pose) -> Array:
        """The points (N,3) f64 in the rig frame, the camera being at T_rig_camera."""
        return transform_points(T_rig_camera, self.points_m.astype(np.float64))


def camera_surfaces(
    views: Sequence[CameraView], calibration: RigCalibration, frame: int | None = None
) -> tuple[list[Surface], tuple[str, ...]]:
    """One surface a camera that has images, depth and a pose; a sentence for each that has not.

    `frame` picks one panoramic frame, None averages them all. The calibration's depth correction is applied.
    """
    surfaces: list[Surface] = []
    skipped: list[str] = []
    for view in views:
        camera = calibration.camera(view.camera_id)
        if camera is None:
            skipped.append(f"{view.name}: left out, the calibration could not place it")
        elif not frames_of(view, frame):
            skipped.append(f"{view.name}: left out, it delivered no colour with depth")
        else:
            try:
                surfaces.append(camera_surface(view, camera.depth_correction, frame))
            except DataError as error:
                skipped.append(f"{view.name}: left out, {error}")
    return surfaces, tuple(skipped)


def frames_of(view: CameraView, frame: int | None) -> list[int]:
    """Indices of the frames to use: those that hold colour and depth, or only the one asked for."""
    count = min(len(view.color), max(len(view.raw), len(view.depth_mm)))
    return [k for k in range(count) if frame is None or k == frame]


def clean_disparity(grid: DepthGrid, measured: Array) -> tuple[Array, Array, Mask]:
    """A disparity image (H,W) smoothed; cosines of incidence; which pixels hold a surface."""
    disparity = smooth_disparity(measured)
    incidence = cos_incidence(grid, disparity)
    return disparity, incidence, solid_pixels(disparity, incidence)


def camera_surface(
    view: CameraView, correction: DepthCorrection | None = None, frame: int | None = None
) -> Surface:
    """The cleaned, coloured points of one camera; ValueError when the view has no such frame.

    Flying points at edges of depth, speckle, and points whose colour is hidden are left out.
    """
    frames = frames_of(view, frame)
    if not frames:
        raise ValueError(f"{view.name} has no colour with depth in frame {frame}")
    grid = depth_grid(view.model, view.depth_frame)
    measured = mean_disparity([disparity_image(view, k) for k in frames])
    disparity, incidence, solid = clean_disparity(grid, measured)
    rows, columns = np.nonzero(solid)
    pixels = np.column_stack([columns, rows])
    points, depth_m = grid_points(grid, pixels, disparity[rows, columns], correction)
    sigma = depth_sigma_m(grid.raw_model, depth_m, rounded_to_mm=not view.raw) / incidence[rows, columns]
    seen, color_pixels = seen_in_color(view.model.color, points)
    return Surface(
        camera_id=view.camera_id,
        name=view.name,
        points_m=points[seen].astype(np.float32),
        sigma_m=sigma[seen].astype(np.float32),
        colors=sample_colors(mean_color([view.color[k] for k in frames]), color_pixels),
    )
