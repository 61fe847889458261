"""What a colour camera sees: points within its field and not hidden behind nearer ones."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from rig_calib.projection import inside, pixel_rays, project
from rig_protocol.camera import Intrinsics

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_HIDDEN_RATIO = 1.03  # a point this much farther than another on its colour pixel is hidden behind it
_FIELD_MARGIN = 1.02  # half a pixel beyond the corner is still the corner
_OCCLUSION_CELL_PX = 4  # colour pixels a cell of the occlusion test


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


def in_field(intrinsics: Intrinsics, points: Array) -> Mask:
    """Which points (N,3) of the camera frame are before it and no farther off its axis than its corners.

    Farther out a distortion polynomial means nothing, and may fold points back into the image.
    """
    return np.asarray(np.hypot(points[:, 0], points[:, 1]) < _field_tangent(intrinsics) * points[:, 2])


@lru_cache(maxsize=64)
def _field_tangent(intrinsics: Intrinsics) -> float:
    return _FIELD_MARGIN * float(np.nanmax(np.linalg.norm(pixel_rays(intrinsics), axis=-1)))


def seen_in_color(intrinsics: Intrinsics, points: Array) -> tuple[npt.NDArray[np.intp], Array]:
    """Indices of the points that the colour camera sees, and the pixels that they fall on."""
    seen = np.flatnonzero(in_field(intrinsics, points))
    pixels = project(intrinsics, points[seen])
    shown = inside(intrinsics, pixels, margin_px=-0.5)
    seen, pixels = seen[shown], pixels[shown]
    depth_m = points[seen, 2]
    unhidden = DepthBuffer.of(pixels, depth_m).visible(pixels, depth_m)
    return seen[unhidden], pixels[unhidden]


def _cells(color_pixels: Array) -> npt.NDArray[np.intp]:
    return np.maximum(np.rint(color_pixels[:, ::-1] / _OCCLUSION_CELL_PX), 0).astype(np.intp)
