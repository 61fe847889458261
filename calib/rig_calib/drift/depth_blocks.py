"""Disparity in blocks: planes of what a camera sees, and by how much they changed."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DepthCorrection, DepthGrid
from rig_calib.drift.look import Disparity
from rig_calib.drift.motion import move_points
from rig_calib.projection import from_pixels, undistort_pixels
from rig_protocol.poses import inverse, transform_points

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

BLOCK_PX = 16
_MIN_FILLED = 0.5
_MAX_PLANE_RMS = 1.0  # raw steps; the noise has half of one


@dataclass(frozen=True, eq=False)
class DepthBlocks:
    """Blocks (N = R·C) of a disparity image as planes d = level + slope · (pixel − centre), raw steps.

    `known`: at least half of the block is measured; `flat`: one plane explains it, too.
    """

    grid: DepthGrid
    correction: DepthCorrection | None
    shape: tuple[int, int]
    centres: Array
    level: Array
    slope: Array
    known: Mask
    flat: Mask

    @classmethod
    def of(cls, disparity: Disparity, grid: DepthGrid, correction: DepthCorrection | None) -> "DepthBlocks":
        """The blocks of a disparity image, 0 = none."""
        values = _tiles(disparity)
        filled = (values > 0).astype(np.float64)
        offsets = np.arange(BLOCK_PX) - (BLOCK_PX - 1) / 2
        v, u = (axis.ravel() for axis in np.meshgrid(offsets, offsets, indexing="ij"))
        basis = np.column_stack([np.ones(u.size), u, v])
        normal = np.einsum("nk,ki,kj->nij", filled, basis, basis) + 1e-6 * np.eye(3)
        plane = np.linalg.solve(normal, ((values * filled) @ basis)[..., None])[..., 0]
        rms = np.sqrt(
            (((values - plane @ basis.T) * filled) ** 2).sum(axis=1) / np.maximum(filled.sum(axis=1), 1)
        )
        known = filled.mean(axis=1) >= _MIN_FILLED
        rows, columns = disparity.shape[0] // BLOCK_PX, disparity.shape[1] // BLOCK_PX
        row, column = np.divmod(np.arange(rows * columns), columns)
        centres = np.column_stack([column, row]) * float(BLOCK_PX) + (BLOCK_PX - 1) / 2
        flat = known & (rms < _MAX_PLANE_RMS)
        return cls(grid, correction, (rows, columns), centres, plane[:, 0], plane[:, 1:], known, flat)

    @cached_property
    def rays(self) -> Array:
        """Rays (N,3), z = 1, of the centres in the depth camera."""
        return np.column_stack(
            [undistort_pixels(self.grid.intrinsics, self.centres), np.ones(len(self.centres))]
        )

    @cached_property
    def numerator(self) -> Array:
        """q (N,) of z = q / (offset − d): the unit's, times the depth correction at the centre."""
        x, y = from_pixels(self.grid.intrinsics, self.centres).T
        factor = np.ones(len(x)) if self.correction is None else self.correction.factor(x, y)
        return np.asarray(self.grid.raw_model.numerator_m * factor)

    @cached_property
    def depth_m(self) -> Array:
        """Depth (N,) of the centres."""
        return np.asarray(self.numerator / np.maximum(self.grid.raw_model.offset - self.level, 1.0))

    @cached_property
    def points(self) -> Array:
        """Centres (N,3) in the colour camera."""
        return transform_points(self.grid.T_color_grid, self.rays * self.depth_m[:, None])

    @cached_property
    def jacobian(self) -> Array:
        """Change (N,6) of the blocks' disparity by the camera's motion: q/z · n·(−t − ω × p).

        n is the plane n·p = 1 of the depth camera's frame, whose inverse depth is linear in the image.
        """
        slopes = -self.slope * (self.grid.intrinsics.fx, self.grid.intrinsics.fy) / self.numerator[:, None]
        inverse_z = 1 / self.depth_m
        third = inverse_z - (slopes * self.rays[:, :2]).sum(axis=1)
        planes = np.column_stack([slopes, third]) @ inverse(self.grid.T_color_grid)[:3, :3]
        moved = np.einsum("nk,nki->ni", planes, move_points(self.points))
        return np.asarray((self.numerator * inverse_z)[:, None] * moved)

    def at(self, pixels: Array) -> npt.NDArray[np.intp]:
        """Numbers (N,) of the blocks that hold pixels (N,2) of the depth image; -1 outside."""
        column, row = (np.floor((pixels + 0.5) / BLOCK_PX).astype(np.intp)).T
        inside = (column >= 0) & (column < self.shape[1]) & (row >= 0) & (row < self.shape[0])
        return np.where(inside, row * self.shape[1] + column, -1)

    def changes(self, before: Disparity, now: Disparity) -> Array:
        """Mean change (N,) of disparity in each block, where both images have it; NaN where too little."""
        both = ((before > 0) & (now > 0)).astype(np.float32)
        size = (self.shape[1], self.shape[0])
        area = tuple(count * BLOCK_PX for count in self.shape)
        change = cv2.multiply(cv2.subtract(now, before, dtype=cv2.CV_32F), both)[: area[0], : area[1]]
        share = cv2.resize(both[: area[0], : area[1]], size, interpolation=cv2.INTER_AREA).ravel()
        total = cv2.resize(change, size, interpolation=cv2.INTER_AREA).ravel().astype(np.float64)
        return np.where(share >= _MIN_FILLED, total / np.maximum(share, 1e-6), np.nan)


def _tiles(image: Disparity) -> Array:
    """Pixels (R·C, B²) of the whole blocks of an image."""
    rows, columns = (size // BLOCK_PX for size in image.shape)
    cut = image[: rows * BLOCK_PX, : columns * BLOCK_PX].astype(np.float64)
    tiles = cut.reshape(rows, BLOCK_PX, columns, BLOCK_PX).swapaxes(1, 2)
    return tiles.reshape(rows * columns, BLOCK_PX * BLOCK_PX)
