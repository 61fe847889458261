"""Which cameras may share a view, and where in their images, predicted from nominal poses.

Nothing here assumes which image axis is vertical: the poses say it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache, reduce
from itertools import combinations, pairwise

import numpy as np
import numpy.typing as npt

from rig_calib.projection import undistort_pixels
from rig_protocol.camera import Intrinsics
from rig_protocol.compiled import compiled
from rig_protocol.poses import Pose, inverse

Array = npt.NDArray[np.float64]

_GRID_STEP_PX = 16
_DEPTHS_M = (0.5, 1.0, 2.0, 5.0)  # the sensor's range; in between the overlap changes smoothly
_LEAST_AHEAD = 0.1  # of the depth: a pinhole's image ends at right angles to its axis


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle of an image: columns [left, right) and rows [top, bottom)."""

    left: int
    top: int
    right: int
    bottom: int

    def contains(self, pixels: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        """Which pixels (N,2) lie in the region."""
        low, high = (self.left - 0.5, self.top - 0.5), (self.right - 0.5, self.bottom - 0.5)
        return np.asarray(((pixels >= low) & (pixels <= high)).all(axis=1))

    def union(self, other: "Region") -> "Region":
        """The smallest region that holds both."""
        return Region(
            min(self.left, other.left),
            min(self.top, other.top),
            max(self.right, other.right),
            max(self.bottom, other.bottom),
        )

    def meets(self, other: "Region") -> bool:
        """Whether the two share a pixel."""
        across = self.left < other.right and other.left < self.right
        return across and self.top < other.bottom and other.top < self.bottom

    def tiles(self, side_px: int) -> list["Region"]:
        """The region cut into equal parts, about as wide and high as said."""
        columns, rows = (
            np.linspace(low, high, max(round((high - low) / side_px), 1) + 1).round().astype(int).tolist()
            for low, high in ((self.left, self.right), (self.top, self.bottom))
        )
        return [
            Region(left, top, right, bottom)
            for top, bottom in pairwise(rows)
            for left, right in pairwise(columns)
        ]


def joined(regions: Iterable[Region]) -> list[Region]:
    """Regions that are apart and hold all of the given ones."""
    apart: list[Region] = []
    for region in regions:
        met = [other for other in apart if other.meets(region)]
        whole = reduce(Region.union, met, region)
        apart = [other for other in apart if other not in met]
        apart = joined([*apart, whole]) if met else [*apart, whole]
    return apart


def whole_image(intrinsics: Intrinsics) -> Region:
    """The region that is the image."""
    return Region(0, 0, intrinsics.width, intrinsics.height)


def shared_regions(
    cameras: Mapping[int, Intrinsics], nominal: Mapping[int, Pose | None], margin_deg: float
) -> dict[tuple[int, int], tuple[Region, Region]]:
    """For every pair (i, j), i < j, that may share a view: its region in image i and in image j.

    `nominal` holds T_rig_camera; a camera without one may share any part of any other's view. `margin_deg` is
    by how much a camera may point away from its drawing.
    """
    regions = {}
    for i, j in combinations(sorted(cameras), 2):
        T_i, T_j = nominal.get(i), nominal.get(j)
        if T_i is None or T_j is None:
            regions[i, j] = (whole_image(cameras[i]), whole_image(cameras[j]))
            continue
        seen_i = _seen_region(cameras[i], cameras[j], inverse(T_j) @ T_i, margin_deg)
        seen_j = _seen_region(cameras[j], cameras[i], inverse(T_i) @ T_j, margin_deg)
        if seen_i is not None and seen_j is not None:
            regions[i, j] = (seen_i, seen_j)
    return regions


def seen_grid(of: Intrinsics, by: Intrinsics, T_by_of: Pose) -> npt.NDArray[np.bool_]:
    """Where, on a coarse grid (rows, columns) all over image `of`, camera `by` sees at any depth."""
    pixels, rays = _grid(of)
    pinhole = np.array([by.fx, by.fy, by.cx, by.cy])
    low = np.array([-0.5, -0.5])
    seen = _seen(rays, T_by_of, pinhole, low, np.array([by.width, by.height]) - 1.0 - low)
    return seen.reshape(-1, len(np.unique(pixels[:, 0])))


def _seen_region(of: Intrinsics, by: Intrinsics, T_by_of: Pose, margin_deg: float) -> Region | None:
    """The part of image `of` that camera `by` sees at any depth of the sensor's range."""
    pixels, rays = _grid(of)
    # Without distortion, whose polynomial folds back far outside the image.
    pinhole = np.array([by.fx, by.fy, by.cx, by.cy])
    margin_px = np.deg2rad(margin_deg) * by.fx
    low = np.array([-0.5 - margin_px, -0.5 - margin_px])
    seen = _seen(rays, T_by_of, pinhole, low, np.array([by.width, by.height]) - 1.0 - low)
    if not seen.any():
        return None
    first, last = pixels[seen].min(axis=0), pixels[seen].max(axis=0) + 1
    return Region(int(first[0]), int(first[1]), int(last[0]), int(last[1]))


@compiled()
def _seen(rays: Array, T_by_of: Pose, pinhole: Array, low: Array, high: Array) -> npt.NDArray[np.bool_]:
    """Which rays (N,3) a pinhole (fx, fy, cx, cy) sees at any depth, between the pixels `low` and `high`."""
    seen = np.zeros(len(rays), dtype=np.bool_)
    for n in range(len(rays)):
        for depth_m in _DEPTHS_M:
            x, y, z = rays[n, 0] * depth_m, rays[n, 1] * depth_m, rays[n, 2] * depth_m
            X = T_by_of[0, 0] * x + T_by_of[0, 1] * y + T_by_of[0, 2] * z + T_by_of[0, 3]
            Y = T_by_of[1, 0] * x + T_by_of[1, 1] * y + T_by_of[1, 2] * z + T_by_of[1, 3]
            Z = T_by_of[2, 0] * x + T_by_of[2, 1] * y + T_by_of[2, 2] * z + T_by_of[2, 3]
            if Z / depth_m > _LEAST_AHEAD:
                u, v = pinhole[0] * X / Z + pinhole[2], pinhole[1] * Y / Z + pinhole[3]
                seen[n] |= low[0] <= u <= high[0] and low[1] <= v <= high[1]
    return seen


@lru_cache(maxsize=64)
def _grid(intrinsics: Intrinsics) -> tuple[Array, Array]:
    """Pixels (N,2) all over an image, its borders included, and their rays (N,3)."""
    columns = np.append(np.arange(0, intrinsics.width - 1, _GRID_STEP_PX), intrinsics.width - 1)
    rows = np.append(np.arange(0, intrinsics.height - 1, _GRID_STEP_PX), intrinsics.height - 1)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
    return pixels, np.column_stack([undistort_pixels(intrinsics, pixels), np.ones(len(pixels))])
