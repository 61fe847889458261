"""Tracks: matches of pairs joined to points that two or more cameras observe, ready to be adjusted."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy.spatial

from rig_calib.depth_model import DISPARITY_SIGMA
from rig_calib.matching import Matches
from rig_calib.observation_model import Observations
from rig_calib.observed_camera import ObservedCamera
from rig_protocol.poses import Pose, transform_points

Array = npt.NDArray[np.float64]
Track = dict[int, int]
"""Keypoint row by camera id."""

# What the lookup's standard deviation does not hold: smooth distortion of the unit beyond the bias states.
_DISTORTION_SIGMA = 1.2 * DISPARITY_SIGMA
# Distances in the depth image over which the two parts of the error are alike.
_NOISE_LENGTH_PX, _DISTORTION_LENGTH_PX = 8.0, 40.0
# A blob is placed to a share of its size (0.05 on two renderers' images, where nothing else is wrong).
_POSITION_SHARE_OF_SCALE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Observations with a start (P,3) for every point in the rig frame; `cameras` orders the camera ids."""

    cameras: tuple[int, ...]
    observations: Observations
    points: Array

    def noisier(self, pixel: float, disparity: float) -> "Scene":
        """The scene with standard deviations multiplied."""
        seen = self.observations
        scaled = replace(
            seen,
            pixel_sigma=seen.pixel_sigma * pixel,
            disparity_sigma=seen.disparity_sigma * disparity,
        )
        return replace(self, observations=scaled)


def build_tracks(
    cameras: Mapping[int, ObservedCamera], matches: Mapping[tuple[int, int], Matches]
) -> list[Track]:
    """Join matches that share a place into tracks; what would give a camera two places is left out."""
    parent: dict[tuple[int, int], tuple[int, int]] = {}
    tracks: dict[tuple[int, int], Track] = {}

    def root(node: tuple[int, int]) -> tuple[int, int]:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    for (i, j), pairs in sorted(matches.items()):
        places_i, places_j = cameras[i].keypoints.place, cameras[j].keypoints.place
        for a, b in pairs.tolist():
            ends = ((i, int(places_i[a])), (j, int(places_j[b])))
            for node, row in zip(ends, (a, b), strict=True):
                if node not in parent:
                    parent[node], tracks[node] = node, {node[0]: row}
            first, second = root(ends[0]), root(ends[1])
            if first != second and not tracks[first].keys() & tracks[second].keys():
                parent[second] = first
                tracks[first].update(tracks.pop(second))
    return [track for track in tracks.values() if len(track) > 1]


def build_scene(
    cameras: Mapping[int, ObservedCamera],
    tracks: Sequence[Track],
    poses: Mapping[int, Pose],
    pixel_sigma: float,
) -> Scene:
    """Observations of the tracks that have depth in at least one camera, points started from that depth."""
    ids = tuple(sorted(poses))
    position = {camera_id: k for k, camera_id in enumerate(ids)}
    camera = np.array([position[c] for track in tracks for c in track], dtype=np.intp)
    row = np.array([r for track in tracks for r in track.values()], dtype=np.intp)
    point = np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])
    observed = _Columns(cameras, ids, camera, row)
    start = observed.gather(lambda c: transform_points(poses[c.view.camera_id], c.points), 3)
    known = np.isfinite(start[:, 0])
    depths = np.bincount(point[known], minlength=len(tracks))
    points = np.stack(
        [
            np.bincount(point[known], start[known, axis], len(tracks)) / np.maximum(depths, 1)
            for axis in range(3)
        ],
        axis=1,
    )
    keep = depths[point] > 0
    number = np.cumsum(depths > 0) - 1
    grid_pixels = observed.gather(lambda c: c.depth.grid_pixels, 2)
    scale_px = observed.gather(lambda c: c.keypoints.scale_px, 1)[:, 0]
    lookup_sigma = observed.gather(lambda c: c.depth.sigma, 1)[:, 0]
    observations = Observations(
        camera=camera,
        point=number[point],
        pixels=observed.gather(lambda c: c.keypoints.pixels, 2),
        pixel_sigma=np.hypot(pixel_sigma, _POSITION_SHARE_OF_SCALE * scale_px),
        disparity=observed.gather(lambda c: c.depth.disparity, 1)[:, 0],
        slope=observed.gather(lambda c: c.depth.slope, 2),
        grid_pixels=grid_pixels,
        disparity_sigma=_correlated_sigma(camera, grid_pixels, lookup_sigma),
    )
    return Scene(ids, observations.select(keep), points[depths > 0])


@dataclass(frozen=True, slots=True, eq=False)
class _Columns:
    cameras: Mapping[int, ObservedCamera]
    ids: tuple[int, ...]
    camera: npt.NDArray[np.intp]
    row: npt.NDArray[np.intp]

    def gather(self, column: Callable[[ObservedCamera], Array], width: int) -> Array:
        """Values (M,width) of one column of every camera's keypoints, in the order of the observations."""
        out = np.empty((len(self.camera), width))
        for k, camera_id in enumerate(self.ids):
            here = self.camera == k
            values = column(self.cameras[camera_id])
            out[here] = values.reshape(len(values), width)[self.row[here]]
        return out


def _correlated_sigma(camera: npt.NDArray[np.intp], grid_pixels: Array, lookup_sigma: Array) -> Array:
    """Standard deviations (M,) that give crowded disparities together the information they hold.

    Errors that n neighbours share are worth one measurement: each variance is multiplied by the number of
    neighbours, counted by how much they share.
    """
    variance = np.full(len(camera), np.nan)
    for c in np.unique(camera):
        rows = np.flatnonzero((camera == c) & np.isfinite(lookup_sigma))
        crowd = _crowding(grid_pixels[rows], _NOISE_LENGTH_PX)
        wide = _crowding(grid_pixels[rows], _DISTORTION_LENGTH_PX)
        variance[rows] = lookup_sigma[rows] ** 2 * crowd + _DISTORTION_SIGMA**2 * wide
    return np.asarray(np.sqrt(variance))


def _crowding(pixels: Array, length_px: float) -> Array:
    """Σ exp(−r²/2L²) over all points, itself included: how many share a place (N,)."""
    if not len(pixels):
        return np.empty(0)
    tree = scipy.spatial.KDTree(pixels)
    near = tree.sparse_distance_matrix(tree, 3.0 * length_px, output_type="coo_matrix")
    shared = np.exp(-0.5 * (near.data / length_px) ** 2)
    # The distance of a point to itself is 0, which a sparse matrix may or may not store.
    off_diagonal = near.row != near.col
    return np.asarray(1.0 + np.bincount(near.row[off_diagonal], shared[off_diagonal], len(pixels)))
