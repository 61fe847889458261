"""The cylinder that a panorama is drawn on: its pixel grid, and images of distance on it."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Array32 = npt.NDArray[np.float32]

_MAX_SLOPE = float(np.tan(np.deg2rad(55.0)))  # what is farther from the horizon stretches without end
_MAX_HEIGHT_PX = 4096
_GAP_BINS = 360
_MIN_GAP_BINS = 20  # degrees that no camera covers before the panorama is cut open there
_BEHIND_RATIO = 1.05  # a point this much farther than the nearest of its cell lies behind it
_HOLE_PX, _FILL_RATIO = 7, 1.04  # holes narrower than this, between neighbours within 4 %


@dataclass(frozen=True, slots=True)
class Cylinder:
    """Column u looks along azimuth `azimuth_left_rad` − u/`pixels_per_rad`, counter-clockwise from above.

    Row v looks along the slope (height over distance) `slope_top` − v/`pixels_per_rad`. Azimuth 0 is the
    front, pixel centres are at integers.
    """

    width: int
    height: int
    pixels_per_rad: float
    azimuth_left_rad: float
    slope_top: float

    @property
    def closed(self) -> bool:
        """True when the right border continues at the left one."""
        return self.width + 1 >= 2 * np.pi * self.pixels_per_rad

    def column(self, azimuth_rad: Array) -> Array:
        """Sub-pixel column of azimuths (any shape); beyond the width where the cylinder is open."""
        turned = np.mod(self.azimuth_left_rad - azimuth_rad + 0.5 / self.pixels_per_rad, 2 * np.pi)
        return np.asarray(turned * self.pixels_per_rad - 0.5)

    def rays(self) -> Array32:
        """Rays (H,W,3) of all pixels in the view frame, of length one across the axis."""
        azimuth = self.azimuth_left_rad - np.arange(self.width) / self.pixels_per_rad
        slope = self.slope_top - np.arange(self.height) / self.pixels_per_rad
        rays = np.empty((self.height, self.width, 3), np.float32)
        rays[..., 0], rays[..., 1] = np.cos(azimuth), np.sin(azimuth)
        rays[..., 2] = slope[:, None]
        return rays


def fit_cylinder(points: Array, circle_px: int) -> Cylinder:
    """The grid that shows points (N,3), N > 0, of the view frame, `circle_px` columns for a full circle."""
    pixels_per_rad = circle_px / (2 * np.pi)
    azimuth, slope, _ = _cylindrical(points)
    low, high = np.percentile(slope, (0.2, 99.8)).clip(-_MAX_SLOPE, _MAX_SLOPE)
    height = int(np.clip((high - low) * pixels_per_rad, 1, _MAX_HEIGHT_PX))
    left, covered = _covered_azimuths(azimuth)
    return Cylinder(max(1, round(covered * pixels_per_rad)), height, pixels_per_rad, left, float(high))


def splat_distance(cylinder: Cylinder, points: Array, sigma_m: Array32) -> Array32:
    """Distance from the axis (H,W) of points (N,3) in the view frame, NaN where none falls.

    The points of the nearest surface in a pixel are averaged by inverse variance.
    """
    azimuth, slope, distance = _cylindrical(points)
    columns = np.rint(cylinder.column(azimuth)).astype(np.intp)
    rows = np.rint((cylinder.slope_top - slope) * cylinder.pixels_per_rad).astype(np.intp)
    shown = (columns >= 0) & (columns < cylinder.width) & (rows >= 0) & (rows < cylinder.height)
    columns, rows, distance = columns[shown], rows[shown], distance[shown]
    front = distance < _BEHIND_RATIO * _nearest(cylinder, columns, rows, distance)
    index = (rows * cylinder.width + columns)[front]
    weight = 1.0 / np.square(sigma_m[shown][front].astype(np.float64))
    size = cylinder.width * cylinder.height
    total = np.bincount(index, weight, size)
    weighted = np.bincount(index, weight * distance[front], size)
    with np.errstate(invalid="ignore"):  # 0/0 is the NaN that we promise
        return (weighted / total).astype(np.float32).reshape(cylinder.height, cylinder.width)


def fill_small_holes(distance: Array32, closed: bool) -> Array32:
    """The image with holes of a few pixels filled where the neighbours agree on a surface."""
    margin = _HOLE_PX
    image = _wrap(distance, margin, closed)
    kernel, neighbours = np.ones((_HOLE_PX, _HOLE_PX), np.uint8), np.ones((3, 3), np.uint8)
    enclosed = cv2.morphologyEx(np.isfinite(image).astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0
    for _ in range(_HOLE_PX // 2):
        known = np.isfinite(image)
        values = np.where(known, image, np.float32(0))
        farthest = cv2.dilate(values, neighbours)
        nearest = cv2.erode(np.where(known, image, np.float32(np.inf)), neighbours)
        fill = ~known & enclosed & (farthest > 0) & (farthest / _FILL_RATIO < nearest)
        count = cv2.boxFilter(known.astype(np.float32), -1, (3, 3), normalize=False)
        image[fill] = (cv2.boxFilter(values, -1, (3, 3), normalize=False))[fill] / count[fill]
    return np.ascontiguousarray(image[:, margin : image.shape[1] - margin])


def complete(distance: Array32, closed: bool) -> Array32:
    """The image without holes: each is filled smoothly from its border, by a pyramid of averages.

    NaN everywhere only when nothing is known.
    """
    margin = min(256, distance.shape[1])
    image = _wrap(distance, margin, closed)
    known = np.isfinite(image).astype(np.float32)
    filled = _pull_push(np.where(known > 0, image, 0).astype(np.float32), known)
    return np.ascontiguousarray(filled[:, margin : filled.shape[1] - margin])


def _pull_push(value: Array32, weight: Array32) -> Array32:
    """Normalised average: weight 1 keeps the value, 0 takes it from the coarser level."""
    if min(value.shape) < 4:
        total = float(weight.sum())
        coarse = np.full_like(value, float((value * weight).sum()) / total if total else np.nan)
    else:
        down = cv2.pyrDown(weight)
        mean = cv2.pyrDown(value * weight) / np.maximum(down, 1e-6)
        below = _pull_push(mean.astype(np.float32), np.minimum(4 * down, 1).astype(np.float32))
        coarse = np.asarray(cv2.resize(below, value.shape[::-1], interpolation=cv2.INTER_LINEAR))
    return np.asarray(weight * value + (1 - weight) * coarse, dtype=np.float32)


def _wrap(image: Array32, margin: int, closed: bool) -> Array32:
    if closed:
        return np.concatenate([image[:, -margin:], image, image[:, :margin]], axis=1)
    return np.pad(image, ((0, 0), (margin, margin)), constant_values=np.nan)


def _cylindrical(points: Array) -> tuple[Array, Array, Array]:
    """Azimuth, slope and distance from the axis (N,) each."""
    distance = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-9)
    return np.arctan2(points[:, 1], points[:, 0]), points[:, 2] / distance, distance


def _covered_azimuths(azimuth: Array) -> tuple[float, float]:
    """Azimuth of the left border and the angle covered from there to the right, rad."""
    bins = np.floor(np.mod(azimuth, 2 * np.pi) * (_GAP_BINS / (2 * np.pi))).astype(np.intp) % _GAP_BINS
    occupied = np.flatnonzero(np.bincount(bins, minlength=_GAP_BINS))
    gaps = np.diff(occupied, append=occupied[0] + _GAP_BINS) - 1
    widest = int(np.argmax(gaps))
    if gaps[widest] < _MIN_GAP_BINS:
        return np.pi, 2 * np.pi
    bin_rad = 2 * np.pi / _GAP_BINS
    return float((occupied[widest] + 1) * bin_rad), float((_GAP_BINS - gaps[widest]) * bin_rad)


def _nearest(
    cylinder: Cylinder, columns: npt.NDArray[np.intp], rows: npt.NDArray[np.intp], distance: Array
) -> Array:
    """Least distance (N,) in the cell of 2×2 pixels of each point: a near surface is no sieve."""
    width = cylinder.width // 2 + 1
    index = (rows // 2) * width + columns // 2
    nearest = np.full(width * (cylinder.height // 2 + 1), np.inf)
    np.minimum.at(nearest, index, distance)
    return np.asarray(nearest[index])
