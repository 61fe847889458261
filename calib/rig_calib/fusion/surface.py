"""Surface: what one camera contributes to a fused result, cleaned, with colour and noise of each point."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import (
    DepthCorrection,
    DepthGrid,
    depth_edges,
    depth_grid,
    depth_sigma_m,
    disparity_image,
    grid_points,
)
from rig_calib.projection import from_pixels, inside, pixel_rays, project
from rig_calib.rig_calibration import RigCalibration
from rig_calib.view import CameraView
from rig_protocol.camera import Intrinsics
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose, transform_points

Array = npt.NDArray[np.float64]
Array32 = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

# Beyond this angle between surface and ray a Kinect measures nothing (Nguyen, Izadi & Lovell 2012):
# what looks so steep floats between two surfaces.
_MAX_INCIDENCE_DEG = 80.0
_MIN_PATCH_PX = 80  # smaller islands of depth are speckle of the correlator
_MAX_FLICKER = 1.5  # raw steps of standard deviation over frames, three times the noise: an edge flips
# The bilateral filter spans the 9×9 correlation window and keeps steps above three raw steps.
_SMOOTH_WINDOW_PX, _SMOOTH_SIGMA_PX, _SMOOTH_SIGMA_STEPS = 9, 3.0, 1.5
_HIDDEN_RATIO = 1.03  # a point this much farther than another on its colour pixel is hidden behind it
_FIELD_MARGIN = 1.02  # half a pixel beyond the corner is still the corner
_OCCLUSION_CELL_PX = 4  # colour pixels a cell of the occlusion test


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


@dataclass(frozen=True, slots=True, eq=False)
class DepthBuffer:
    """Nearest depth (rows, columns) in each cell of a colour image: what hides what from the camera."""

    nearest_m: Array

    @classmethod
    def of(cls, color_pixels: Array, depth_m: npt.NDArray[np.floating]) -> "DepthBuffer":
        """The buffer of points at pixels (N,2) with depths (N,)."""
        cells = _cells(color_pixels)
        nearest = np.full(cells.max(axis=0, initial=0) + 1, np.inf)
        np.minimum.at(nearest, (cells[:, 0], cells[:, 1]), depth_m)
        return cls(nearest)

    def visible(self, color_pixels: Array, depth_m: Array) -> Mask:
        """Which points (N,) no other is clearly in front of."""
        cells = np.minimum(_cells(color_pixels), np.array(self.nearest_m.shape) - 1)
        return np.asarray(depth_m < self.nearest_m[cells[:, 0], cells[:, 1]] * _HIDDEN_RATIO)


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
            surfaces.append(camera_surface(view, camera.depth_correction, frame))
    return surfaces, tuple(skipped)


def frames_of(view: CameraView, frame: int | None) -> list[int]:
    """Indices of the frames to use: those that hold colour and depth, or only the one asked for."""
    count = min(len(view.color), max(len(view.raw), len(view.depth_mm)))
    return [k for k in range(count) if frame is None or k == frame]


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
    disparity = smooth_disparity(mean_disparity([disparity_image(view, k) for k in frames]))
    incidence = cos_incidence(grid, disparity)
    solid = _solid(disparity, incidence)
    rows, columns = np.nonzero(solid)
    pixels = np.column_stack([columns, rows])
    points, depth_m = grid_points(grid, pixels, disparity[rows, columns], correction)
    color_pixels = project(view.model.color, points)
    seen = inside(view.model.color, color_pixels, margin_px=-0.5) & in_field(view.model.color, points)
    seen[seen] = _unhidden(color_pixels[seen], points[seen, 2])
    sigma = depth_sigma_m(grid.raw_model, depth_m, rounded_to_mm=not view.raw) / incidence[rows, columns]
    return Surface(
        camera_id=view.camera_id,
        name=view.name,
        points_m=points[seen].astype(np.float32),
        sigma_m=sigma[seen].astype(np.float32),
        colors=sample_colors(mean_color([view.color[k] for k in frames]), color_pixels[seen]),
    )


def mean_disparity(images: Sequence[Array]) -> Array:
    """Mean disparity (H,W) over frames, NaN where most frames have none or where it flickers."""
    count, total, squares = (np.zeros(images[0].shape) for _ in range(3))
    for image in images:
        valid = np.isfinite(image)
        value = np.where(valid, image, 0.0)
        count += valid
        total += value
        squares += value * value
    seen = np.maximum(count, 1.0)
    mean = total / seen
    variance = squares / seen - mean * mean
    return np.where((2 * count >= len(images)) & (count > 0) & (variance < _MAX_FLICKER**2), mean, np.nan)


def smooth_disparity(disparity: Array) -> Array:
    """Disparity with its noise smoothed along surfaces and its steps kept (bilateral filter).

    Planes are linear in disparity, so that smoothing over a symmetric window does not bend them.
    """
    known = np.isfinite(disparity)
    # A hole becomes 0, hundreds of steps from every measurement, and gets no weight.
    filled = np.where(known, disparity, 0.0).astype(np.float32)
    smooth = cv2.bilateralFilter(filled, _SMOOTH_WINDOW_PX, _SMOOTH_SIGMA_STEPS, _SMOOTH_SIGMA_PX)
    return np.where(known, smooth, np.nan)


def cos_incidence(grid: DepthGrid, disparity: Array) -> Array:
    """Cosine (H,W) of the angle between ray and surface normal, NaN beside holes.

    A plane n·X = h has 1/z = (n·(x, y, 1))/h: the gradient of inverse depth is the normal.
    """
    inverse_depth = (grid.raw_model.offset - disparity) / grid.raw_model.numerator_m
    by_row, by_column = np.gradient(inverse_depth)
    nx, ny = by_column * grid.intrinsics.fx, by_row * grid.intrinsics.fy
    rows, columns = np.indices(disparity.shape)
    rays = from_pixels(grid.intrinsics, np.stack([columns, rows], axis=-1).astype(np.float64))
    nz = inverse_depth - nx * rays[..., 0] - ny * rays[..., 1]
    length = np.sqrt(nx**2 + ny**2 + nz**2) * np.sqrt(1.0 + (rays**2).sum(axis=-1))
    return np.asarray(inverse_depth / length)


def mean_color(images: Sequence[ImageU8]) -> Array32:
    """Mean image (H,W,3), RGB, of BGR or grey images."""
    total = np.zeros((*images[0].shape[:2], 3), np.float32)
    for image in images:
        total += image[..., ::-1] if image.ndim == 3 else image[..., None]
    return np.asarray(total / len(images), dtype=np.float32)


def sample_colors(image: Array32, pixels: Array) -> ImageU8:
    """Colours (N,3) u8 of an image (H,W,3) at sub-pixel positions (N,2), bilinear."""
    return np.asarray(np.clip(np.rint(sample_image(image, pixels)), 0, 255), dtype=np.uint8)


def sample_image(image: Array32, pixels: Array) -> Array32:
    """Values (N,) or (N,C) of an image (H,W) or (H,W,C) at sub-pixel positions (N,2), bilinear.

    Beyond the border the border's value holds.
    """
    # remap takes no list longer than 32767, so that the list becomes a nearly square map.
    width = max(1, int(np.ceil(np.sqrt(len(pixels)))))
    maps = np.zeros((width, width, 2), np.float32)
    maps.reshape(-1, 2)[: len(pixels)] = pixels
    sampled = cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled.reshape(width * width, *image.shape[2:])[: len(pixels)], dtype=np.float32)


def in_field(intrinsics: Intrinsics, points: Array) -> Mask:
    """Which points (N,3) of the camera frame are before it and no farther off its axis than its corners.

    Farther out a distortion polynomial means nothing, and may fold points back into the image.
    """
    corner = float(np.nanmax(np.linalg.norm(pixel_rays(intrinsics), axis=-1)))
    tangent = corner * _FIELD_MARGIN
    return np.asarray(np.hypot(points[:, 0], points[:, 1]) <= tangent * points[:, 2])


def _solid(disparity: Array, incidence: Array) -> Mask:
    steep = ~(incidence > np.cos(np.deg2rad(_MAX_INCIDENCE_DEG)))
    edges = depth_edges(disparity) | steep
    beside_edge = cv2.dilate(edges.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~beside_edge).astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= _MIN_PATCH_PX
    large[0] = False  # the background
    return np.asarray(large[labels])


def _unhidden(color_pixels: Array, depth_m: Array) -> Mask:
    return DepthBuffer.of(color_pixels, depth_m).visible(color_pixels, depth_m)


def _cells(color_pixels: Array) -> npt.NDArray[np.intp]:
    return np.maximum(np.rint(color_pixels[:, ::-1] / _OCCLUSION_CELL_PX), 0).astype(np.intp)
