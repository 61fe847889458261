"""Planes that one camera's depth shows: walls, floor and ceiling, not what is small or curved.

On the rays r = (x, y, 1) of the depth camera a plane has the inverse depth π · r: it is linear in disparity,
where the noise is the same everywhere. The image is cut into cells, each with a disparity and its slope;
planes are the linear functions that many cells follow, but for a bend that the unit's depth may have.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DISPARITY_SIGMA, DepthCorrection, DepthGrid, depth_basis
from rig_calib.disparity_windows import fitted_planes
from rig_calib.projection import from_pixels, undistort_pixels

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Index = npt.NDArray[np.intp]

HALF_CELL_PX = 7
_CELL_PX = 24
_MIN_FILLED = 0.7  # of a cell
# A cell is smooth when what is left of its own plane looks like noise: RMS and worst.
_MAX_RMS, _MAX_WORST = 1.6 * DISPARITY_SIGMA, 5.0 * DISPARITY_SIGMA
_BLOCK, _MIN_FILLED_BLOCK = 4, 0.6  # cells a side that propose a plane
# Raw steps by which a cell is off its plane: noise, and what no bend follows.
_CELL_SIGMA, _TOLERANCE = 0.3, 1.0
_MAX_CELL_RMS = 0.45  # a curved surface within the tolerance fills it evenly: 0.58
_BESIDE = 2.5  # cells this near a plane are none of another
_SLOPE_TOLERANCE = 0.3  # steps per pixel, of a cell's own slope: four standard deviations
_BEND_SIGMA = 0.08  # of x², xy and y² in depth, as shares of it: 2.3 % from edge to edge of the image
_MIN_SHARE = 0.05  # of the image, in one piece
# Largest curvature z/2r that a plane may have for all that its cells' slopes show; a column of 0.6 m has 2.
_MAX_CURVATURE, _CURVATURE_SIGMAS = 0.5, 2.0
_MAX_PLANES = 6
_REFITS = 6


@dataclass(frozen=True, slots=True, eq=False)
class DepthPlane:
    """M cells of a camera's depth that lie on one plane: `disparity` (M,) at `grid_pixels` (M,2).

    `normal` (3,) is the plane π of the corrected depth in the depth camera's frame, `points_m` (M,3) is where
    the cells' rays meet it; `misfit` (M,) is what it and its bend leave of the cells, raw steps.
    """

    grid_pixels: Array
    disparity: Array
    normal: Array
    points_m: Array
    misfit: Array


def depth_planes(grid: DepthGrid, disparity: Array, correction: DepthCorrection | None) -> list[DepthPlane]:
    """The planes of a disparity image (H,W), largest first, each pixel in one of them at most."""
    cells = _cells(grid, disparity, correction)
    return [_depth_plane(cells, grid, plane, on) for plane, on in _largest(cells)]


def cell_places(pixels: Array) -> Index:
    """Column and row (N,2) of the cells that pixels (N,2) of a depth image are nearest to."""
    return np.asarray(np.rint((pixels - HALF_CELL_PX) / _CELL_PX).astype(np.intp))


@dataclass(frozen=True, slots=True, eq=False)
class _Plane:
    """Inverse depth `normal` · r in raw steps, and the residuals (N,) of all cells from it and its bend."""

    normal: Array
    residual: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """N smooth cells: inverse depth in raw steps, `value` (N,), on `rays` (N,3), and `slope` (N,2) by ray.

    `bend` (N,3) is x², xy, y²; `number` (R,C) has the image's cells' rows in these, -1 for none, and `block`
    (B,K) rows of cells that propose a plane together.
    """

    at: Array
    disparity: Array
    rays: Array
    value: Array
    slope: Array
    slope_tolerance: float
    bend: Array
    number: Index
    block: Index

    def fit(self, on: Mask) -> _Plane:
        """The plane through some cells, with the bend that the unit is likely to have."""
        design = np.column_stack([self.rays, self.value[on].mean() * self.bend])
        prior = np.diag(np.repeat([1e-3, _CELL_SIGMA / _BEND_SIGMA], 3) ** 2)
        normal = design[on].T @ design[on] + prior
        theta = np.linalg.solve(normal, design[on].T @ self.value[on])
        return _Plane(theta[:3], self.value - design @ theta)

    def on(self, plane: _Plane) -> Mask:
        """Which cells follow a plane, in value and in slope."""
        tilt = np.abs(self.slope - plane.normal[:2]).max(axis=1)
        return np.asarray((np.abs(plane.residual) < _TOLERANCE) & (tilt < self.slope_tolerance))

    def confirm(self, plane: _Plane, on: Mask) -> bool:
        """Whether cells are a plane: enough of them in one piece, and shown to be flat."""
        fewest = _MIN_SHARE * self.number.size
        if on.sum() < fewest or np.sqrt(np.mean(plane.residual[on] ** 2)) > _MAX_CELL_RMS:
            return False
        image = np.where(self.number >= 0, on[self.number], False).astype(np.uint8)
        pieces = cv2.connectedComponentsWithStats(image)[2]
        return bool(pieces[1:, cv2.CC_STAT_AREA].max() >= fewest) and self._curvature(on) < _MAX_CURVATURE

    def _curvature(self, on: Mask) -> float:
        """How curved, as a share of depth by squared ray, cells may be by how their slopes change."""
        along, slope = self.rays[on, :2], self.slope[on]
        along, slope = along - along.mean(axis=0), slope - slope.mean(axis=0)
        square = np.maximum((along**2).sum(axis=0), 1e-9)
        change = (along * slope).sum(axis=0) / square
        sigma = np.sqrt(np.mean((slope - change * along) ** 2, axis=0) / square)
        worst = np.abs(change) + _CURVATURE_SIGMAS * sigma
        return float(worst.max() / (2.0 * self.value[on].mean()))


def _largest(cells: _Cells) -> Iterator[tuple[_Plane, Mask]]:
    """Planes and the cells on them; what most cells agree with is tried first."""
    near = np.abs(cells.value - _proposals(cells) @ cells.rays.T) < _TOLERANCE
    free, found = np.ones(len(cells.value), dtype=bool), 0
    while found < _MAX_PLANES and len(near):
        support = near @ free.astype(np.float32)
        best = int(support.argmax())
        if support[best] < _BLOCK**2 // 2:
            return
        plane, on = _grown(cells, near[best] & free, free)
        if cells.confirm(plane, on):
            yield plane, on
            found += 1
            free &= ~on & (np.abs(plane.residual) > _BESIDE)
            near = np.delete(near, best, axis=0)
        else:  # nor will those that agree with the same cells lead anywhere
            alike = near @ on.astype(np.float32) > 0.5 * near @ free.astype(np.float32)
            alike[best] = True
            near = near[~alike]


def _depth_plane(cells: _Cells, grid: DepthGrid, plane: _Plane, on: Mask) -> DepthPlane:
    normal = plane.normal / grid.raw_model.numerator_m
    points_m = cells.rays[on] / (cells.rays[on] @ normal)[:, None]
    return DepthPlane(cells.at[on], cells.disparity[on], normal, points_m, plane.residual[on])


def _grown(cells: _Cells, on: Mask, free: Mask) -> tuple[_Plane, Mask]:
    """The plane of some cells, and the free cells that turn out to be on it."""
    for _ in range(_REFITS):
        plane, before = cells.fit(on), on
        on = cells.on(plane) & free
        if on.sum() < _BLOCK**2 // 2 or (before == on).all():
            break
    return plane, on


def _proposals(cells: _Cells) -> Array:
    """Planes (B,3) through blocks of cells."""
    known = (cells.block >= 0)[..., None]
    rays, value = cells.rays[cells.block] * known, cells.value[cells.block][..., None] * known
    normal = rays.transpose(0, 2, 1) @ rays
    return np.asarray(np.linalg.solve(normal, rays.transpose(0, 2, 1) @ value)[..., 0])


def _cells(grid: DepthGrid, disparity: Array, correction: DepthCorrection | None) -> _Cells:
    camera, model = grid.intrinsics, grid.raw_model
    rows = np.arange(HALF_CELL_PX, camera.height - HALF_CELL_PX, _CELL_PX)
    columns = np.arange(HALF_CELL_PX, camera.width - HALF_CELL_PX, _CELL_PX)
    at = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
    fitted = np.full((len(at), 3), np.nan)
    fitted_planes(disparity, at, HALF_CELL_PX, _MIN_FILLED, _MAX_RMS, _MAX_WORST, fitted)
    smooth = np.isfinite(fitted[:, 0])
    number = np.where(smooth, np.cumsum(smooth) - 1, -1).reshape(len(rows), len(columns))
    at, fitted = at[smooth], fitted[smooth]
    x, y = from_pixels(camera, at).T
    factor = np.ones(len(at)) if correction is None else correction.factor(x, y)
    return _Cells(
        at=at,
        disparity=fitted[:, 0],
        rays=np.column_stack([undistort_pixels(camera, at), np.ones(len(at))]),
        value=(model.offset - fitted[:, 0]) / factor,
        slope=-fitted[:, 1:] * (camera.fx, camera.fy) / factor[:, None],
        slope_tolerance=_SLOPE_TOLERANCE * camera.fx,
        bend=depth_basis(x, y, 6)[:, 3:],
        number=number,
        block=_blocks(number),
    )


def _blocks(number: Index) -> Index:
    """Rows (B,K) of the cells in each block of an image of cell numbers, in which -1 is none."""
    if min(number.shape) < _BLOCK:
        return np.empty((0, _BLOCK**2), dtype=np.intp)
    windows = np.lib.stride_tricks.sliding_window_view(number, (_BLOCK, _BLOCK))[::2, ::2]
    rows = windows.reshape(-1, _BLOCK**2)
    return np.asarray(rows[(rows >= 0).mean(axis=1) >= _MIN_FILLED_BLOCK])
