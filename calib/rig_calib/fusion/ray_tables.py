"""Tables of a calibrated rig for the live fusion: rays, colour pixels, shared views, windows of the cylinder.

All that needs a lens's inverse or a polynomial is worked out once, in double precision.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import MAX_RANGE_M, MIN_RANGE_M, DepthCorrection, DepthGrid, depth_grid
from rig_calib.fusion.cylinder import Cylinder, fit_cylinder
from rig_calib.fusion.live_arrays import EMPTY, UNSEEN, Drum, Lens, Ring
from rig_calib.fusion.visibility import in_field
from rig_calib.projection import from_pixels, pixel_rays, project
from rig_protocol.camera import CameraModel, Intrinsics
from rig_protocol.frames import DepthFrame
from rig_protocol.poses import Pose, inverse, transform_points

Array = npt.NDArray[np.float64]
Array32 = npt.NDArray[np.float32]

MAX_PARTNERS = 8
_BLOCK_PX = 8  # shared views are found at every eighth pixel, and widened by as much
_RANGE_M = np.array([MIN_RANGE_M, MAX_RANGE_M])
_USUAL_RANGES_M = np.array([1.0, 2.0, 4.0])  # where the panorama's border is to be right
_COLOR_RANGES_M = (0.55, MAX_RANGE_M)
_LARGEST = 32_000  # number in a table of 16 bits


@dataclass(frozen=True, slots=True, eq=False)
class PlacedGrid:
    """The depth images of one camera, and where they are in the rig."""

    model: CameraModel
    grid: DepthGrid
    T_rig_grid: Pose
    correction: DepthCorrection | None

    @classmethod
    def of(
        cls,
        model: CameraModel,
        depth_frame: DepthFrame,
        T_rig_camera: Pose,
        correction: DepthCorrection | None,
    ) -> "PlacedGrid":
        """DataError when the model lacks what the depth's grid needs."""
        grid = depth_grid(model, depth_frame)
        return cls(model, grid, np.asarray(T_rig_camera @ grid.T_color_grid), correction)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of its depth images."""
        return self.grid.intrinsics.height, self.grid.intrinsics.width

    def lens(self) -> Lens:
        """What cleaning needs."""
        raw, at = self.grid.raw_model, self.grid.intrinsics
        limits = raw.numerator_m / MAX_RANGE_M, raw.numerator_m / MIN_RANGE_M
        numbers = (raw.numerator_m, raw.offset, *limits, at.fx, at.fy, at.cx, at.cy)
        return Lens(*map(np.float32, numbers))

    def rays(self) -> Array:
        """Rays (H,W,3) in the grid's frame, z = 1."""
        plane = pixel_rays(self.grid.intrinsics)
        return np.concatenate([plane, np.ones((*self.shape, 1))], axis=-1)

    def scale(self) -> Array:
        """What (H,W) makes corrected 1/z of q = numerator / z."""
        scale = np.full(self.shape, 1.0 / self.grid.raw_model.numerator_m)
        if self.correction is None:
            return scale
        rows, columns = np.indices(self.shape)
        at = from_pixels(self.grid.intrinsics, np.stack([columns, rows], axis=-1).astype(np.float64))
        return np.asarray(scale / self.correction.factor(at[..., 0], at[..., 1]))

    def color_pixels(self) -> Array:
        """(4,H,W): u, v, du, dv of the colour pixel (u, v) + (du, dv) / z, NaN where none sees it.

        Straight in 1/z but for the lens's curvature over the parallax, a tenth of a pixel: a line through
        what is seen at 0.55 and at 8 m.
        """
        flat = self.rays().reshape(-1, 3)
        near_m, far_m = _COLOR_RANGES_M
        near, far = (self._color_pixels_at(flat * range_m) for range_m in _COLOR_RANGES_M)
        slope = (near - far) / (1 / near_m - 1 / far_m)
        table = np.concatenate([far - slope / far_m, slope], axis=1).T.reshape(4, *self.shape)
        return np.asarray(table)

    def _color_pixels_at(self, points: Array) -> Array:
        points = transform_points(self.grid.T_color_grid, points)
        seen = in_field(self.model.color, points)
        pixels = np.full((len(points), 2), np.nan)
        pixels[seen] = project(self.model.color, points[seen])
        return pixels

    def points(self, ranges_m: Array, step: int) -> Array:
        """Points (R,h,w,3) of the rig frame at every `step`-th pixel and some depths; NaN without a ray.

        The last row and column are among them.
        """
        rows, columns = (np.unique(np.append(np.arange(0, n, step), n - 1)) for n in self.shape)
        turned = self.rays()[np.ix_(rows, columns)] @ self.T_rig_grid[:3, :3].T
        return np.asarray(ranges_m[:, None, None, None] * turned + self.T_rig_grid[:3, 3])

    def sides(self) -> Array:
        """Planes (4,4) of the rig frame around its view, some pixels wider: inward normals, and distances."""
        rays, lens = pixel_rays(self.grid.intrinsics), self.grid.intrinsics
        margin = _BLOCK_PX / np.array([lens.fx, lens.fy])
        left, top = np.nanmin(rays, axis=(0, 1)) - margin
        right, bottom = np.nanmax(rays, axis=(0, 1)) + margin
        normals = [[1.0, 0.0, -left], [-1.0, 0.0, right], [0.0, 1.0, -top], [0.0, -1.0, bottom]]
        return np.asarray(np.array(normals) @ inverse(self.T_rig_grid)[:3])


def ring_tables(grids: Sequence[PlacedGrid]) -> Ring:
    """Tables of cameras whose depth images are of one size."""
    shape = grids[0].shape
    tables = np.empty((len(grids), 6, *shape), np.int16)
    planes = np.empty((len(grids), 6, 4), np.float32)
    scans = np.empty(len(grids), np.int64)
    for i, grid in enumerate(grids):
        rays, color = grid.rays(), grid.color_pixels()
        for k, values in enumerate((rays[..., 0], rays[..., 1], *color)):
            planes[i, k], tables[i, k] = _from_plane(values)
        scans[i] = 1 if float(np.nanmean(color[2])) > 0 else -1
        tables[i, 2][~np.isfinite(color).all(axis=0)] = UNSEEN
    partners, spans = _shared_views(grids)
    return Ring(
        scales=np.array([grid.scale() for grid in grids], np.float32),
        tables=tables,
        planes=planes,
        scans=scans,
        T_rig_grid=np.array([grid.T_rig_grid[:3] for grid in grids], np.float32),
        T_grid_rig=np.array([inverse(grid.T_rig_grid)[:3] for grid in grids], np.float32),
        lenses=np.array([_lens_numbers(grid.grid.intrinsics) for grid in grids], np.float32),
        partners=partners,
        spans=spans,
    )


def _from_plane(values: Array) -> tuple[Array, npt.NDArray[np.int16]]:
    """c (4,) and a table (H,W) with values = c₀ + c₁ x + c₂ y + c₃ table, to a part in 65,000 of the rest."""
    height, width = values.shape
    known = np.isfinite(values)
    if not known.any():
        return np.zeros(4), np.zeros(values.shape, np.int16)
    rows, columns = np.nonzero(known)
    step = max(1, len(rows) // 10_000)  # a plane needs no more
    design = np.stack([np.ones(len(rows)), columns, rows], axis=1)[::step]
    plane = (
        np.linalg.lstsq(design, values[known][::step], rcond=None)[0].astype(np.float32).astype(np.float64)
    )
    rest = values - (plane[0] + plane[1] * np.arange(width) + plane[2] * np.arange(height)[:, None])
    rest = np.where(known, rest, 0.0)
    unit = np.float32(max(float(np.abs(rest).max()) / _LARGEST, 1e-12))
    return np.array([*plane, unit]), np.rint(rest / np.float64(unit)).astype(np.int16)


def circle_around(grids: Sequence[PlacedGrid], T_view_rig: Pose, circle_px: int) -> Cylinder:
    """The cylinder that shows what the cameras can see."""
    seen = [grid.points(_USUAL_RANGES_M, _BLOCK_PX).reshape(-1, 3) for grid in grids]
    points = np.concatenate(seen)
    return fit_cylinder(transform_points(T_view_rig, points[np.isfinite(points).all(axis=1)]), circle_px)


def drum_around(grids: Sequence[PlacedGrid], T_view_rig: Pose, cylinder: Cylinder, circle_px: int) -> Drum:
    """The cylinder for the kernels, with a window for every camera, as wide as the widest needs."""
    windows = [_window(grid, T_view_rig, cylinder, circle_px) for grid in grids]
    width = min(max(width for _, width in windows), circle_px)
    starts = np.array([start for start, _ in windows], np.int64)
    # A pixel's centre is at an integer: half a pixel more, and columns are cut.
    middles = cylinder.azimuth_left_rad + (0.5 - starts - width / 2) / cylinder.pixels_per_rad
    T_window_rig = np.array([_turned(angle) @ T_view_rig[:3] for angle in middles], np.float32)
    return Drum(
        T_window_rig=T_window_rig,
        pixels_per_rad=np.float32(cylinder.pixels_per_rad),
        slope_top=np.float32(cylinder.slope_top),
        circle=circle_px,
        starts=starts,
        cells=np.full((len(grids), width, cylinder.height), EMPTY, np.uint64),
    )


def _turned(angle_rad: float) -> Array:
    """Rotation (3,3) that maps what is at this azimuth to the x axis."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _window(grid: PlacedGrid, T_view_rig: Pose, cylinder: Cylinder, circle_px: int) -> tuple[int, int]:
    """First column and number of columns of the circle on which a camera's points may fall."""
    ends = transform_points(T_view_rig, grid.points(_RANGE_M, _BLOCK_PX).reshape(-1, 3)).reshape(2, -1, 3)
    ends = ends[:, np.isfinite(ends).all(axis=(0, 2))]
    near, far = np.arctan2(ends[..., 1], ends[..., 0])
    swept = np.mod(far - near + np.pi, 2 * np.pi) - np.pi  # no line turns by half a circle about an axis
    turned = (cylinder.azimuth_left_rad - np.maximum(near, near + swept)) * cylinder.pixels_per_rad
    first = np.mod(np.floor(turned + 0.5).astype(np.int64), circle_px)
    last = first + np.ceil(np.abs(swept) * cylinder.pixels_per_rad).astype(np.int64)
    begun, ended = (np.bincount(columns, minlength=2 * circle_px) for columns in (first, last + 1))
    covered = np.cumsum(begun - ended) > 0
    taken = np.flatnonzero(covered[:circle_px] | covered[circle_px:])
    gaps = np.diff(taken, append=taken[0] + circle_px)
    widest = int(np.argmax(gaps))
    margin = 2 * _BLOCK_PX
    width = circle_px - int(gaps[widest]) + 1 + 2 * margin
    start = int(taken[(widest + 1) % len(taken)]) - margin
    return (start % circle_px, width) if width < circle_px else (0, circle_px)


def _shared_views(grids: Sequence[PlacedGrid]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Partners (C,K) of every camera, those that share most first, and spans (C,K,H,2) of columns."""
    partners = np.full((len(grids), MAX_PARTNERS), -1, np.int64)
    spans = np.zeros((len(grids), MAX_PARTNERS, grids[0].shape[0], 2), np.int64)
    rows, columns = (-(-size // _BLOCK_PX) for size in grids[0].shape)
    sides = [grid.sides() for grid in grids]
    for i, grid in enumerate(grids):
        near, far = grid.points(_RANGE_M, _BLOCK_PX)[:, :rows, :columns]
        masks = {j: _passes(near, far, sides[j]) for j in range(len(grids)) if j != i}
        by_share = sorted(
            (j for j in masks if masks[j].any()), key=lambda j: (-np.count_nonzero(masks[j]), j)
        )
        for k, j in enumerate(by_share[:MAX_PARTNERS]):
            partners[i, k] = j
            spans[i, k] = _spans(masks[j], grid.shape)
    return partners, spans


def _passes(near: Array, far: Array, sides: Array) -> npt.NDArray[np.bool_]:
    """Which lines (...) from near to far points (..., 3) have a part within all planes (n, 4)."""
    begin, end = (points @ sides[:, :3].T + sides[:, 3] for points in (near, far))
    with np.errstate(divide="ignore", invalid="ignore"):  # of lines along a plane
        crossing = begin / (begin - end)
    enters = np.where(begin >= 0, 0.0, np.where(end >= 0, crossing, np.inf)).max(axis=-1)
    leaves = np.where(end >= 0, 1.0, np.where(begin >= 0, crossing, -np.inf)).min(axis=-1)
    return np.asarray((enters <= leaves) & np.isfinite(begin + end).all(axis=-1))


def _spans(blocks: npt.NDArray[np.bool_], shape: tuple[int, int]) -> npt.NDArray[np.int64]:
    """First column and the one after the last (H,2) of the blocks that are set, each with its neighbours."""
    padded = np.pad(blocks, ((1, 1), (0, 0)))
    rows = _any_of(np.stack([padded[:-2], padded[1:-1], padded[2:]]))
    first = (rows.argmax(axis=1) - 1) * _BLOCK_PX
    last = (rows.shape[1] - rows[:, ::-1].argmax(axis=1) + 1) * _BLOCK_PX
    spans = np.clip(np.stack([first, last], axis=1), 0, shape[1]) * _any_of(rows.T)[:, None]
    return np.asarray(np.repeat(spans, _BLOCK_PX, axis=0)[: shape[0]], dtype=np.int64)


def _any_of(masks: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    return np.asarray(masks.any(axis=0))


def _lens_numbers(intrinsics: Intrinsics) -> tuple[float, ...]:
    return intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy, *intrinsics.dist
