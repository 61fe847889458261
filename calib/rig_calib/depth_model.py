"""Depth images to metres and to points in the colour camera, and the per-unit depth correction.

All three depth inputs become one thing first: a disparity image on some grid. Raw disparity is that
already; millimetres become the raw disparity that the unit's model assigns to them, because the
sensor's noise is the same at every distance only when written in disparity.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rig_calib.projection import from_pixels, pixel_rays, project
from rig_calib.view import CameraView
from rig_protocol.camera import CameraModel, Intrinsics, RawDepthModel
from rig_protocol.errors import DataError
from rig_protocol.frames import NO_DEPTH_MM, NO_DISPARITY, DepthFrame
from rig_protocol.poses import Pose, transform_points

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

MODEL_NAME = "polynomial-scale"
MAX_TERMS = 10

MIN_RANGE_M, MAX_RANGE_M = 0.4, 8.0
DISPARITY_SIGMA = 0.5
"""Standard deviation of one pixel's disparity in raw steps, quantisation included, at every distance."""

# A step of this many raw steps between neighbours, beyond what a plane explains, is an edge of depth:
# six standard deviations of the noise.
_EDGE_STEP = 3.0
_MM_ROUNDING_M = 1e-3 / np.sqrt(12.0)


@dataclass(frozen=True, slots=True)
class DepthCorrection:
    """z_true = z · (1 + Σ c_k b_k(x, y)), b = (1, x, y, x², xy, y², x³, x²y, xy², y³) as far as there are c.

    x = (u − cx)/fx and y = (v − cy)/fy of the pixel (u, v) that holds the depth, in the camera whose grid it
    is on.
    """

    coefficients: tuple[float, ...]

    def to_dict(self) -> dict[str, Any]:
        """The `depth_correction` object of `calibration.json`."""
        return {
            "model": MODEL_NAME,
            "equation": "z_true = z * (1 + sum c_k b_k(x, y)); "
            "b = 1, x, y, x^2, xy, y^2, x^3, x^2 y, x y^2, y^3; "
            "x = (u - cx)/fx, y = (v - cy)/fy",
            "coefficients": list(self.coefficients),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "DepthCorrection":
        """Read the `depth_correction` object; DataError for another model."""
        if values.get("model") != MODEL_NAME:
            raise DataError(f"depth correction model {values.get('model')!r} is not {MODEL_NAME!r}")
        coefficients = tuple(float(c) for c in values["coefficients"])
        if not 0 < len(coefficients) <= MAX_TERMS or not np.isfinite(coefficients).all():
            raise DataError(f"a depth correction has one to {MAX_TERMS} finite coefficients")
        return cls(coefficients)

    def factor(self, x: Array, y: Array) -> Array:
        """What to multiply measured depth by, at normalised pixel coordinates x, y (any shape)."""
        terms = depth_basis(x, y, len(self.coefficients))
        return np.asarray(1.0 + terms @ np.array(self.coefficients))


def depth_basis(x: Array, y: Array, terms: int) -> Array:
    """The basis (..., terms) of the correction: 1, x, y, x², xy, y², x³, x²y, xy², y³."""
    square, product, other = x * x, x * y, y * y
    basis = [np.ones_like(x), x, y, square, product, other, square * x, square * y, x * other, y * other]
    return np.stack(basis[:terms], axis=-1) if terms else np.empty((*np.shape(x), 0))


@dataclass(frozen=True, slots=True, eq=False)
class DepthGrid:
    """The pixel grid that a depth image lives on: its camera, where that is, and its disparity model."""

    intrinsics: Intrinsics
    T_color_grid: Pose
    raw_model: RawDepthModel


@dataclass(frozen=True, slots=True, eq=False)
class DepthPoints:
    """Points in the colour camera frame with the colour pixel that each falls on (sub-pixel, maybe outside).

    `pixels` (N,2) int: column and row in the depth image; `sigma_z_m` (N,): standard deviation of the
    depth; `near_edge` (N,): beside a hole or a step of depth, where a point may float between surfaces.
    """

    points_m: Array
    pixels: npt.NDArray[np.intp]
    sigma_z_m: Array
    color_pixels: Array
    near_edge: Mask


def depth_grid(model: CameraModel, depth_frame: DepthFrame) -> DepthGrid:
    """The grid of a unit's depth images; DataError when its model lacks what the grid needs."""
    if depth_frame == "color":
        return DepthGrid(model.color, np.eye(4), model.raw_model)
    if model.depth is None or model.T_color_depth is None:
        raise DataError(
            "depth in the depth camera needs that camera's intrinsics and T_color_depth; "
            "state them, or deliver depth registered to colour"
        )
    return DepthGrid(model.depth, model.T_color_depth, model.raw_model)


def disparity_image(view: CameraView, frame: int) -> Array:
    """Disparity (H,W) in raw steps of one frame's depth image, NaN where there is none or out of range.

    DataError when the image and its camera's intrinsics differ in size.
    """
    grid = depth_grid(view.model, view.depth_frame)
    image = view.raw[frame] if view.raw else view.depth_mm[frame]
    if image.shape != (grid.intrinsics.height, grid.intrinsics.width):
        raise DataError(
            f"{view.name}: depth image is {image.shape[1]}×{image.shape[0]}, its camera "
            f"{grid.intrinsics.width}×{grid.intrinsics.height}"
        )
    if view.raw:
        disparity = np.where(image >= NO_DISPARITY, np.nan, image.astype(np.float64))
    else:
        depth_m = np.where(image == NO_DEPTH_MM, np.nan, image * 1e-3)
        disparity = disparity_of_depth(grid.raw_model, depth_m)
    return _within_range(disparity, grid.raw_model)


def depth_of_disparity(model: RawDepthModel, disparity: Array) -> Array:
    """Metres of disparity: z = numerator / (offset − d)."""
    return np.asarray(model.numerator_m / (model.offset - disparity))


def disparity_of_depth(model: RawDepthModel, depth_m: Array) -> Array:
    """Disparity in raw steps of metres: d = offset − numerator / z."""
    return np.asarray(model.offset - model.numerator_m / depth_m)


def depth_sigma_m(model: RawDepthModel, depth_m: Array, rounded_to_mm: bool) -> Array:
    """Standard deviation of depth: σ_z = z²·σ_d/numerator (Khoshelham & Elberink 2012), plus rounding."""
    sigma = depth_m**2 * (DISPARITY_SIGMA / model.numerator_m)
    return np.hypot(sigma, _MM_ROUNDING_M) if rounded_to_mm else sigma


def depth_points(view: CameraView, frame: int, correction: DepthCorrection | None = None) -> DepthPoints:
    """Every measured pixel of one frame as a point in the colour camera (eq. 1–3 of the paper).

    Holes and depths outside 0.4–8 m are left out. `correction` is the unit's, from a calibration.
    """
    grid = depth_grid(view.model, view.depth_frame)
    disparity = disparity_image(view, frame)
    rows, columns = np.nonzero(np.isfinite(disparity) & np.isfinite(pixel_rays(grid.intrinsics)[..., 0]))
    pixels = np.column_stack([columns, rows])
    points, depth_m = grid_points(grid, pixels, disparity[rows, columns], correction)
    return DepthPoints(
        points_m=points,
        pixels=pixels,
        sigma_z_m=depth_sigma_m(grid.raw_model, depth_m, rounded_to_mm=not view.raw),
        color_pixels=project(view.model.color, points),
        near_edge=depth_edges(disparity)[rows, columns],
    )


def grid_points(
    grid: DepthGrid, pixels: npt.NDArray[np.intp], disparity: Array, correction: DepthCorrection | None = None
) -> tuple[Array, Array]:
    """Points (N,3) in the colour camera and depths (N,) along the depth camera's axis (eq. 1, 2).

    `pixels` (N,2) are column and row on the grid, `disparity` (N,) what was measured there.
    """
    depth_m = depth_of_disparity(grid.raw_model, disparity)
    if correction is not None:
        x, y = from_pixels(grid.intrinsics, pixels.astype(np.float64)).T
        depth_m = depth_m * correction.factor(x, y)
    rays = pixel_rays(grid.intrinsics)[pixels[:, 1], pixels[:, 0]]
    points = np.column_stack([rays * depth_m[:, None], depth_m])
    return transform_points(grid.T_color_grid, points), depth_m


def depth_edges(disparity: Array) -> Mask:
    """Pixels (H,W) beside a hole or a step: where the second difference is missing or large.

    The second difference is blind to slanted planes, whose disparity is linear in the image.
    """
    padded = np.pad(disparity, 1, mode="edge")
    centre = 2.0 * disparity
    across = np.abs(padded[1:-1, :-2] + padded[1:-1, 2:] - centre)
    down = np.abs(padded[:-2, 1:-1] + padded[2:, 1:-1] - centre)
    return np.asarray(~((across < _EDGE_STEP) & (down < _EDGE_STEP)))


def _within_range(disparity: Array, model: RawDepthModel) -> Array:
    limits = disparity_of_depth(model, np.array([MIN_RANGE_M, MAX_RANGE_M]))
    return np.where((disparity >= limits[0]) & (disparity <= limits[1]), disparity, np.nan)
