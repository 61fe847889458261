"""RangeImage: one camera's cleaned depth with its surfaces' slant and colour, as a volume takes it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DepthGrid, depth_grid, depth_sigma_m, disparity_image, grid_points
from rig_calib.fusion.cleaning import bridge_gaps, mean_disparity
from rig_calib.fusion.gains import NO_GAIN, Gain
from rig_calib.fusion.sampling import mean_color, sample_image
from rig_calib.fusion.surface import clean_disparity, frames_of
from rig_calib.fusion.visibility import seen_in_color
from rig_calib.parallel import in_threads
from rig_calib.projection import pixel_rays
from rig_calib.rig_calibration import CalibratedCamera, RigCalibration
from rig_calib.view import CameraView
from rig_protocol.errors import DataError
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose

Array32 = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class RangeImage:
    """Depth (H,W) of one camera on its grid, corrected, without flying pixels.

    `inverse_depth`: 1/m, 0 where no surface was measured. `incidence`: cosine of the angle between ray and
    normal. `colors` (H,W,3), RGB; black, and `colored` False, where the colour camera does not see the
    surface. `sigma_1m`: standard deviation in metres of depth at 1 m; it grows with z². `frames`: how many
    were averaged.
    """

    grid: DepthGrid
    T_rig_grid: Pose
    inverse_depth: Array32
    incidence: Array32
    colors: ImageU8
    colored: npt.NDArray[np.bool_]
    sigma_1m: float
    frames: int


def range_images(
    views: Sequence[CameraView], calibration: RigCalibration, gains: Mapping[int, Gain]
) -> tuple[list[RangeImage], tuple[str, ...]]:
    """One a camera that has images, depth and a pose, the mean of its frames; a sentence for each other."""
    made = list(in_threads(lambda view: _image_or_reason(view, calibration, gains), views))
    images = [one for one in made if isinstance(one, RangeImage)]
    return images, tuple(one for one in made if isinstance(one, str))


def range_image(view: CameraView, camera: CalibratedCamera, gain: Gain = NO_GAIN) -> RangeImage:
    """The mean of a view's frames at the calibrated camera's place; DataError for what makes no image."""
    frames = frames_of(view, None)
    grid = depth_grid(view.model, view.depth_frame)
    measured = bridge_gaps(mean_disparity([disparity_image(view, k) for k in frames]))
    disparity, incidence, solid = clean_disparity(grid, measured)
    solid = solid & np.isfinite(pixel_rays(grid.intrinsics)).all(axis=-1)
    rows, columns = np.nonzero(solid)
    at = np.column_stack([columns, rows])
    points, depth_m = grid_points(grid, at, disparity[rows, columns], camera.depth_correction)
    inverse_depth = np.zeros(disparity.shape, np.float32)
    inverse_depth[rows, columns] = 1.0 / depth_m
    seen, color_pixels = seen_in_color(view.model.color, points)
    colors, colored = np.zeros((*disparity.shape, 3), np.uint8), np.zeros(disparity.shape, np.bool_)
    sampled = sample_image(mean_color([view.color[k] for k in frames]), color_pixels) * gain
    colors[rows[seen], columns[seen]] = np.clip(np.rint(sampled), 0, 255)
    colored[rows[seen], columns[seen]] = True
    return RangeImage(
        grid=grid,
        T_rig_grid=np.asarray(camera.T_rig_camera @ grid.T_color_grid),
        inverse_depth=inverse_depth,
        incidence=np.where(solid, incidence, 0.0).astype(np.float32),
        colors=colors,
        colored=colored,
        sigma_1m=float(depth_sigma_m(grid.raw_model, np.ones(1), rounded_to_mm=False)[0]),
        frames=len(frames),
    )


def _image_or_reason(
    view: CameraView, calibration: RigCalibration, gains: Mapping[int, Gain]
) -> RangeImage | str:
    camera = calibration.camera(view.camera_id)
    if camera is None:
        return f"{view.name}: left out, the calibration could not place it"
    if not frames_of(view, None):
        return f"{view.name}: left out, it delivered no colour with depth"
    try:
        return range_image(view, camera, gains.get(view.camera_id, NO_GAIN))
    except DataError as error:
        return f"{view.name}: left out, {error}"
