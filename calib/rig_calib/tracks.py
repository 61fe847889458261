"""Tracks: matches of pairs joined to points that two or more cameras observe, ready to be adjusted."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.matching import Matches
from rig_calib.noise import NoiseModel
from rig_calib.observation_model import Observations
from rig_calib.observed_camera import ObservedCamera
from rig_protocol.poses import Pose, transform_points

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Observations with a start (P,3) for every point in the rig frame; `cameras` orders the camera ids."""

    cameras: tuple[int, ...]
    observations: Observations
    points: Array


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """`count` tracks; observation m is keypoint `row` (M,) of the camera with id `camera` (M,) on `track`.

    The observations of a track stand together.
    """

    count: int
    track: npt.NDArray[np.intp]
    camera: npt.NDArray[np.intp]
    row: npt.NDArray[np.intp]


def build_tracks(cameras: Mapping[int, ObservedCamera], matches: Mapping[tuple[int, int], Matches]) -> Tracks:
    """Join matches that share a place into tracks; what would give a camera two places is left out."""
    if _every_place_once(cameras, matches):
        return _pairs_as_tracks(matches)
    return _joined_tracks(cameras, matches)


def _pairs_as_tracks(matches: Mapping[tuple[int, int], Matches]) -> Tracks:
    """Every match a track of its own."""
    ordered = sorted(matches.items())
    rows = np.concatenate([np.empty((0, 2), np.intp), *(pairs for _, pairs in ordered)])
    ids = [np.empty((0, 2), np.intp), *(np.tile(pair, (len(pairs), 1)) for pair, pairs in ordered)]
    return Tracks(len(rows), np.repeat(np.arange(len(rows)), 2), np.concatenate(ids).ravel(), rows.ravel())


def _joined_tracks(
    cameras: Mapping[int, ObservedCamera], matches: Mapping[tuple[int, int], Matches]
) -> Tracks:
    parent: dict[tuple[int, int], tuple[int, int]] = {}
    rows_of: dict[tuple[int, int], dict[int, int]] = {}  # of a track, by camera id

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
                    parent[node], rows_of[node] = node, {node[0]: row}
            first, second = root(ends[0]), root(ends[1])
            if first != second and not rows_of[first].keys() & rows_of[second].keys():
                parent[second] = first
                rows_of[first].update(rows_of.pop(second))
    found = [rows for rows in rows_of.values() if len(rows) > 1]
    return Tracks(
        len(found),
        np.repeat(np.arange(len(found)), [len(rows) for rows in found]),
        np.array([camera for rows in found for camera in rows], dtype=np.intp),
        np.array([row for rows in found for row in rows.values()], dtype=np.intp),
    )


def _every_place_once(
    cameras: Mapping[int, ObservedCamera], matches: Mapping[tuple[int, int], Matches]
) -> bool:
    """Whether no two matches share a place, as with patches."""
    places: dict[int, list[npt.NDArray[np.intp]]] = {}
    for pair, rows in matches.items():
        for camera_id, own in zip(pair, rows.T, strict=True):
            places.setdefault(camera_id, []).append(cameras[camera_id].keypoints.place[own])
    joined = [np.concatenate(parts) for parts in places.values()]
    return all(len(np.unique(own)) == len(own) for own in joined)


def build_scene(
    cameras: Mapping[int, ObservedCamera], tracks: Tracks, poses: Mapping[int, Pose], noise: NoiseModel
) -> Scene:
    """Observations of the tracks that have depth in at least one camera, points started from that depth."""
    ids = tuple(sorted(poses))
    camera, point = np.searchsorted(ids, tracks.camera), tracks.track
    observed = _Columns(cameras, ids, camera, tracks.row)
    start = observed.gather(lambda c: transform_points(poses[c.view.camera_id], c.points), 3)
    points, with_depth = _mean_points(point, start, tracks.count)
    number = np.cumsum(with_depth) - 1
    observations = _observations(observed, number[point], noise)
    return Scene(ids, observations.select(with_depth[point]), points[with_depth])


def _mean_points(
    point: npt.NDArray[np.intp], start: Array, count: int
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Mean position (P,3) of each point over the observations that have depth, and which points have any."""
    known = np.isfinite(start[:, 0])
    depths = np.bincount(point[known], minlength=count)
    sums = [np.bincount(point[known], start[known, axis], count) for axis in range(3)]
    return np.stack(sums, axis=1) / np.maximum(depths, 1)[:, None], depths > 0


def _observations(observed: "_Columns", point: npt.NDArray[np.intp], noise: NoiseModel) -> Observations:
    pixels = observed.gather(lambda c: c.keypoints.pixels, 2)
    grid_pixels = observed.gather(lambda c: c.depth.grid_pixels, 2)
    information = observed.gather(lambda c: c.keypoints.information.reshape(-1, 4), 4).reshape(-1, 2, 2)
    lookup_sigma = observed.gather(lambda c: c.depth.sigma, 1)[:, 0]
    whitener = np.empty_like(information)
    for c in np.unique(observed.camera):
        rows = observed.camera == c
        whitener[rows] = noise.pixel_whitener(information[rows], pixels[rows])
    return Observations(
        camera=observed.camera,
        point=point,
        pixels=pixels,
        pixel_whitener=whitener,
        disparity=observed.gather(lambda c: c.depth.disparity, 1)[:, 0],
        slope=observed.gather(lambda c: c.depth.slope, 2),
        grid_pixels=grid_pixels,
        disparity_sigma=_by_camera(
            observed.camera,
            np.isfinite(lookup_sigma),
            lambda r: noise.disparity_sigma(grid_pixels[r], lookup_sigma[r]),
        ),
    )


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


def _by_camera(
    camera: npt.NDArray[np.intp],
    usable: npt.NDArray[np.bool_],
    sigma: Callable[[npt.NDArray[np.intp]], Array],
) -> Array:
    """Standard deviations (M,), one camera's rows at a time; NaN for rows that are not usable."""
    out = np.full(len(camera), np.nan)
    for c in np.unique(camera):
        rows = np.flatnonzero((camera == c) & usable)
        out[rows] = sigma(rows)
    return out
