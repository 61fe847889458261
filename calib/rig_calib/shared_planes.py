"""Walls, floor and ceiling that several cameras see, as landmarks of the adjustment.

Two cameras' planes are one wall when they differ by no more than what is left open about them, when neither
camera has another plane that could be meant, and when both see it in one place or it is known too well to be
another one, as a door is or a shelf in front of it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.bundle_adjustment import Adjustment
from rig_calib.carried_planes import CarriedPlanes, carry
from rig_calib.crowding import crowding
from rig_calib.depth_model import DepthCorrection
from rig_calib.depth_planes import HALF_CELL_PX, DepthPlane, cell_places, depth_planes
from rig_calib.keypoint_depth import window_sigma
from rig_calib.observation_model import CameraState, PlaneObservations
from rig_calib.observed_camera import ObservedCamera
from rig_calib.parallel import in_threads
from rig_calib.projection import project
from rig_calib.surface_transfer import transform_planes
from rig_protocol.poses import Pose, inverse, transform_points

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

# Squared normal errors in three dimensions: 99.9 %, and what is beyond doubt another plane.
_SAME, _ANOTHER = 16.3, 30.0
_PRECISE_M = 0.01  # a surface parallel to a wall stands off it by more than three of it
_COMMON_CELLS = 8
_NEAR_M = 0.1
# What depth is off a plane and its bend, as a share of it, and over how many pixels that is alike.
_DISTORTION_SHARE, _DISTORTION_LENGTH_PX = 0.002, 55.0
# A unit's depth bias is no constant share: what is right at one distance is off by this at twice of it.
_BIAS_SHARE, _BIAS_LENGTH_PX = 0.003, 180.0
_ERROR_OF_MISFIT = 1.8  # a plane and its bend follow some of it


@dataclass(frozen=True, slots=True, eq=False)
class SharedPlanes:
    """Planes π (K,3) in the rig frame, π · X = 1, and what two or more cameras measured of each."""

    planes: Array
    seen: PlaneObservations


NOTHING_SHARED = SharedPlanes(np.empty((0, 3)), PlaneObservations.none())


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """A plane that one camera of the adjustment sees; T_rig_grid is its depth camera's pose."""

    camera: int
    side: ObservedCamera
    T_rig_grid: Pose
    plane: DepthPlane


def find_shared_planes(
    cameras: Mapping[int, ObservedCamera], order: Sequence[int], adjustment: Adjustment
) -> SharedPlanes:
    """Planes that two or more cameras share, as far as an adjustment of the cameras in `order` can tell."""
    sides = [cameras[c] for c in order]
    found = _found(sides, adjustment.states)
    if not found:
        return NOTHING_SHARED
    seen = _observations(found)
    starts = [transform_planes(one.T_rig_grid, one.plane.normal[None])[0] for one in found]
    carried = carry(np.array(starts), seen, sides, adjustment)
    group = _groups(carried, found)
    planes = [carried.planes[group == g].mean(axis=0) for g in range(group.max() + 1)]
    shared = seen.select(group[seen.plane] >= 0)
    return SharedPlanes(np.array(planes).reshape(-1, 3), shared.renumbered(group))


def _found(sides: Sequence[ObservedCamera], states: Sequence[CameraState]) -> list[_Found]:
    def find(side_and_state: tuple[ObservedCamera, CameraState]) -> list[DepthPlane]:
        side, state = side_and_state
        bias = tuple(state.bias.tolist())
        return depth_planes(side.grid, side.disparity, DepthCorrection(bias) if bias else None)

    return [
        _Found(c, sides[c], states[c].T_rig_camera @ sides[c].grid.T_color_grid, plane)
        for c, planes in enumerate(in_threads(find, zip(sides, states, strict=True)))
        for plane in planes
    ]


def _observations(found: Sequence[_Found]) -> PlaneObservations:
    """Every second cell of every plane, in the order of the planes."""
    used = [cell_places(one.plane.grid_pixels).sum(axis=1) % 2 == 0 for one in found]
    sizes = [int(mask.sum()) for mask in used]

    def joined(columns: Sequence[Array]) -> Array:
        return np.concatenate([column[mask] for column, mask in zip(columns, used, strict=True)])

    camera = np.repeat(np.array([one.camera for one in found], dtype=np.intp), sizes)
    noise = np.repeat([window_sigma(HALF_CELL_PX, one.side.depth_frames) for one in found], sizes)
    disparity = joined([one.plane.disparity for one in found])
    pixels = joined([one.plane.grid_pixels for one in found])
    depth = np.repeat([one.side.grid.raw_model.offset for one in found], sizes) - disparity
    excess = (joined([one.plane.misfit for one in found]) ** 2 - noise**2) / depth**2
    share = max(_DISTORTION_SHARE, _ERROR_OF_MISFIT * float(np.sqrt(max(excess.mean(), 0.0))))
    sigma = np.empty(len(camera))
    for c in np.unique(camera):
        here = camera == c
        sigma[here] = np.hypot(noise[here], _distortion(pixels[here], depth[here], share))
    return PlaneObservations(camera, np.repeat(np.arange(len(found)), sizes), pixels, disparity, sigma)


def _distortion(pixels: Array, depth: Array, share: float) -> Array:
    """Standard deviations (N,), raw steps, of one camera's cells: of errors that its neighbours share, too.

    `depth` (N,) is inverse, in raw steps. n cells with one error are given the weight of one.
    """
    octaves = np.log2(depth)
    alike = share**2 * crowding(pixels, _DISTORTION_LENGTH_PX)
    bias = (_BIAS_SHARE * (octaves - octaves.mean())) ** 2 * crowding(pixels, _BIAS_LENGTH_PX)
    return np.asarray(depth * np.sqrt(alike + bias))


def _groups(carried: CarriedPlanes, found: Sequence[_Found]) -> Index:
    """Number (K,) of the shared plane that each is, -1 for none; within one, each passes for every other."""
    squared, sigma_m = carried.differences()
    elsewhere = carried.camera[:, None] != carried.camera
    likely = (squared < _ANOTHER) & elsewhere
    per_camera = likely.astype(int) @ (carried.camera[:, None] == carried.camera)
    same = likely & (squared < _SAME) & (per_camera == 1) & (per_camera == 1).T
    group = np.arange(len(found))
    pairs = np.argwhere(np.triu(same))
    for a, b in pairs[np.argsort(squared[tuple(pairs.T)])]:
        one, other = group == group[a], group == group[b]
        if group[a] == group[b] or not same[np.ix_(one, other)].all():
            continue
        if sigma_m[a, b] < _PRECISE_M or _meet(found[a], found[b]):
            group[other] = group[a]
    _, number, count = np.unique(group, return_inverse=True, return_counts=True)
    return np.where(count > 1, np.cumsum(count > 1) - 1, -1)[number]


def _meet(a: _Found, b: _Found) -> bool:
    """Whether cells of one fall on cells of the other, in the camera that sees the other."""
    points = transform_points(inverse(b.T_rig_grid) @ a.T_rig_grid, a.plane.points_m)
    there = cell_places(project(b.side.grid.intrinsics, points[points[:, 2] > _NEAR_M]))
    cells = set(map(tuple, cell_places(b.plane.grid_pixels).tolist()))
    return sum(tuple(place) in cells for place in there.tolist()) >= _COMMON_CELLS
