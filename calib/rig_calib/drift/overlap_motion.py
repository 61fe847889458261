"""By how much two neighbours' views of one place disagree with where calibration puts the cameras."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.drift.landmarks import WINDOW_PX, choose_landmarks, gradient_tensors, track
from rig_calib.drift.look import GREY, HALF, Look, full_pixels
from rig_calib.drift.motion import Measurements, Motion, estimate_motion, pixel_jacobian
from rig_calib.drift.own_motion import undisturbed
from rig_calib.drift.reference import Reference
from rig_calib.projection import project, undistort_pixels
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose, inverse, transform_points

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Index = npt.NDArray[np.intp]

_SMOOTH_DEPTH = 1.08  # farthest over nearest in a landmark's window: the image warps by depth
_SAME_DEPTH = 0.06  # relative difference up to which both depth cameras see one surface
# Levels of the pyramid and largest shift in full pixels: where both images nearly fit, and where not.
_NEAR, _FAR = (1, 16.0), (3, 60.0)
_MIN_LANDMARKS, _MIN_BLOCKS = 12, 12
_NOISE_OF_MEAN = 0.5  # standard deviation of the mean of four looks over that of one
# What is smooth over the overlap (lens, distortion of depth) is worth a few measurements, not all.
_LENS_SIGMA_PX = 0.15  # halved pixels
_DEPTH_SIGMA_STEPS, _INDEPENDENT_DEPTHS = 1.5, 5.0


@dataclass(frozen=True, slots=True, eq=False)
class OverlapView:
    """Motion of j against where the overlap takes it to be, i in its place.

    `likeness`: correlation of the landmarks' windows, median, before that motion.
    """

    motion: Motion
    likeness: float


@dataclass(frozen=True, slots=True, eq=False)
class Overlap:
    """Where cameras i and j see the same, when T_j_i is so, going by i's depth.

    `landmarks` (N,2) on the part `window` of i's halved image, `points` (N,3) in j, the derivative (N,2,6) of
    their shift by j's motion, the depth blocks (N,2) of i and j that they fall on; `warp`: where each pixel
    of the window is in j's halved image. `pairs` (M,2): depth blocks of i and j on one surface.
    """

    i: Reference
    j: Reference
    T_j_i: Pose
    window: tuple[slice, slice]
    warp: npt.NDArray[np.float32]
    landmarks: Array
    points: Array
    jacobian: Array
    landmark_blocks: Index
    pairs: Index

    def view(
        self, looks: tuple[Look, Look], still: tuple[Mask, Mask], *, far: bool = False
    ) -> OverlapView | None:
        """What both cameras show of the overlap; None when too little of it is seen.

        `looks` of i and j at about one time, `still`: which depth blocks (N,) of each show what they did.
        `far`: also shifts of some degrees, less surely.
        """
        calm = [
            undisturbed(mask, one.blocks.shape) for mask, one in zip(still, (self.i, self.j), strict=True)
        ]
        use = calm[0][self.landmark_blocks[:, 0]] & calm[1][self.landmark_blocks[:, 1]]
        depth = self._depth(looks, still)
        if use.sum() < _MIN_LANDMARKS or len(depth) < _MIN_BLOCKS:
            return None
        one = np.ascontiguousarray(looks[0].contrast[self.window])
        columns, rows = self.warp[..., 0], self.warp[..., 1]
        warped = cv2.remap(looks[1].contrast, columns, rows, cv2.INTER_LINEAR, borderValue=GREY)
        other = np.asarray(warped, dtype=np.uint8)
        noise = _NOISE_OF_MEAN * max(self.i.noise_levels, self.j.noise_levels)
        tensors = gradient_tensors(one, self.landmarks)
        levels, most_px = _FAR if far else _NEAR
        shifts, found = track(one, other, self.landmarks, tensors, noise, _LENS_SIGMA_PX, levels=levels)
        found &= np.abs(shifts.shift).max(axis=1) < most_px
        motion = estimate_motion((shifts.whitened(self.jacobian, use & found), depth))
        likeness = float(np.median(_correlation(one, other, self.landmarks[use])))
        return None if motion is None else OverlapView(motion, likeness)

    def _depth(self, looks: tuple[Look, Look], still: tuple[Mask, Mask]) -> Measurements:
        """Disparity that j measures minus what it should see of i's blocks."""
        a, b = self.pairs.T
        blocks_i, blocks_j = self.i.blocks, self.j.blocks
        change_i = blocks_i.changes(self.i.look.disparity, looks[0].disparity)[a]
        change_j = blocks_j.changes(self.j.look.disparity, looks[1].disparity)[b]
        use = still[0][a] & still[1][b] & np.isfinite(change_i + change_j)
        a, b = a[use], b[use]
        raw = blocks_i.grid.raw_model
        z = blocks_i.numerator[a] / np.maximum(raw.offset - blocks_i.level[a] - change_i[use], 1.0)
        points = transform_points(blocks_i.grid.T_color_grid, blocks_i.rays[a] * z[:, None])
        in_grid = _in_grid(self.T_j_i, self.j, points)
        offset = project(blocks_j.grid.intrinsics, in_grid) - blocks_j.centres[b]
        seen = blocks_j.level[b] + change_j[use] + (blocks_j.slope[b] * offset).sum(axis=1)
        expected = blocks_j.grid.raw_model.offset - blocks_j.numerator[b] / in_grid[:, 2]
        sigma = _DEPTH_SIGMA_STEPS * np.sqrt(max(len(a) / _INDEPENDENT_DEPTHS, 1.0))
        residual = np.column_stack([(seen - expected) / sigma, np.zeros(len(a))])
        jacobian = np.zeros((len(a), 2, 6))
        jacobian[:, 0] = blocks_j.jacobian[b] / sigma
        return Measurements(residual, jacobian, rows=1)


def _correlation(one: ImageU8, other: ImageU8, pixels: Array) -> Array:
    """Correlation coefficients (N,) of the windows around pixels (N,2) of two images."""
    a, b = one.astype(np.float32), other.astype(np.float32)
    at = pixels.astype(np.intp)

    def mean(image: npt.NDArray[np.float32]) -> Array:
        return np.asarray(cv2.blur(image, (WINDOW_PX, WINDOW_PX))[at[:, 1], at[:, 0]], dtype=np.float64)

    covariance = mean(a * b) - mean(a) * mean(b)
    variances = (mean(a * a) - mean(a) ** 2) * (mean(b * b) - mean(b) ** 2)
    return np.asarray(covariance / np.sqrt(np.maximum(variances, 1e-6)))


def find_overlap(i: Reference, j: Reference, T_j_i: Pose) -> Overlap | None:
    """The overlap of two cameras; None when they share nothing that both have depth of."""
    places, z = _warp(i, j, T_j_i)
    inside = _inside(places, j.depth_m.shape, WINDOW_PX // 2)
    if not inside.any():
        return None
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    window = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    allowed = (inside & _smooth(i.depth_m) & _seen_by_both(places, z, j))[window]
    if min(allowed.shape) <= WINDOW_PX:
        return None
    landmarks = choose_landmarks(np.ascontiguousarray(i.look.contrast[window]), allowed)
    at = landmarks.astype(np.intp)
    halved = landmarks + np.array([window[1].start, window[0].start])
    points = np.column_stack(
        [undistort_pixels(i.known.model.color, full_pixels(halved)), np.ones(len(halved))]
    )
    points *= i.depth_m[window][at[:, 1], at[:, 0], None].astype(np.float64)
    points_j = transform_points(T_j_i, points)
    jacobian = _unwarped(places[window], at) @ pixel_jacobian(j.known.model.color, points_j)
    blocks = np.column_stack([_blocks(i, points), _blocks(j, points_j)])
    kept = (blocks >= 0).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
    return Overlap(
        i,
        j,
        T_j_i,
        window,
        np.ascontiguousarray(places[window], dtype=np.float32),
        landmarks[kept],
        points_j[kept],
        jacobian[kept],
        blocks[kept],
        _block_pairs(i, j, T_j_i),
    )


def _warp(i: Reference, j: Reference, T_j_i: Pose) -> tuple[Array, Array]:
    """Where each halved pixel (h,w) of i is in j's image (h,w,2), and how deep there (h,w); else −1."""
    rows, columns = np.nonzero(np.isfinite(i.depth_m))
    rays = undistort_pixels(i.known.model.color, full_pixels(np.column_stack([columns, rows])))
    z = i.depth_m[rows, columns].astype(np.float64)
    points = transform_points(T_j_i, np.column_stack([rays * z[:, None], z]))
    ahead = points[:, 2] > 0.2
    rows, columns, points = rows[ahead], columns[ahead], points[ahead]
    places, depth = np.full((*i.depth_m.shape, 2), -1.0), np.full(i.depth_m.shape, -1.0)
    places[rows, columns] = (project(j.known.model.color, points) - (HALF - 1) / 2) / HALF
    depth[rows, columns] = points[:, 2]
    return places, depth


def _inside(places: Array, shape: tuple[int, ...], margin: int) -> Mask:
    low, high = margin, np.array([shape[1], shape[0]]) - 1 - margin
    return np.asarray(((places >= low) & (places <= high)).all(axis=-1))


def _smooth(depth_m: npt.NDArray[np.float32]) -> Mask:
    window = np.ones((WINDOW_PX, WINDOW_PX), np.uint8)
    farthest, nearest = cv2.dilate(depth_m, window), cv2.erode(depth_m, window)
    return np.asarray(np.isfinite(farthest) & (farthest / _SMOOTH_DEPTH < nearest))


def _seen_by_both(places: Array, z: Array, j: Reference) -> Mask:
    """Where j's own depth says that it sees the same surface."""
    at = np.rint(places).astype(np.intp)
    size = j.depth_m.shape
    seen = j.depth_m[at[..., 1].clip(0, size[0] - 1), at[..., 0].clip(0, size[1] - 1)]
    return np.asarray(np.abs(seen - z) < _SAME_DEPTH * np.abs(z))


def _unwarped(places: Array, at: Index) -> Array:
    """Inverse (N,2,2) of the warp's derivative: shifts of j's image to shifts of i's."""
    rows, columns = at[:, 1].clip(2, places.shape[0] - 3), at[:, 0].clip(2, places.shape[1] - 3)
    across = (places[rows, columns + 2] - places[rows, columns - 2]) / 4
    down = (places[rows + 2, columns] - places[rows - 2, columns]) / 4
    warp = np.stack([across, down], axis=-1)
    sane = np.abs(np.linalg.det(warp)) > 0.1
    warp[~sane] = np.eye(2)
    out = np.linalg.inv(warp)
    out[~sane] = np.nan
    return np.asarray(out)


def _in_grid(T_j_i: Pose, j: Reference, points: Array) -> Array:
    """Points of i's colour camera in j's depth camera."""
    return transform_points(inverse(j.blocks.grid.T_color_grid) @ T_j_i, points)


def _blocks(camera: Reference, points: Array) -> Index:
    """Depth blocks (N,) that points (N,3) in the colour camera fall on; −1 = none."""
    in_grid = transform_points(inverse(camera.blocks.grid.T_color_grid), points)
    return camera.blocks.at(project(camera.blocks.grid.intrinsics, in_grid))


def _block_pairs(i: Reference, j: Reference, T_j_i: Pose) -> Index:
    """Flat blocks (M,2) of both cameras on one surface."""
    flat = np.flatnonzero(i.blocks.flat)
    in_grid = _in_grid(T_j_i, j, i.blocks.points[flat])
    flat, in_grid = flat[in_grid[:, 2] > 0.2], in_grid[in_grid[:, 2] > 0.2]
    partner = j.blocks.at(project(j.blocks.grid.intrinsics, in_grid))
    good = (partner >= 0) & j.blocks.flat[partner]
    good &= np.abs(j.blocks.depth_m[partner] - in_grid[:, 2]) < _SAME_DEPTH * in_grid[:, 2]
    return np.column_stack([flat[good], partner[good]])
