"""What a capture of the simulated ring offers: true correspondences among its keypoints, and their noise.

Independent of the estimator's matcher: SIFT on the whole images, mutual nearest descriptors where both
cameras look, and the truth as the judge.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt
import scipy.optimize
import scipy.spatial

from rig_agent.simulator.ring import VirtualRig
from rig_agent.simulator.scene import Scene
from rig_agent.simulator.units import VirtualUnit, draw_unit
from rig_calib.tracks import Scene as TrackScene
from rig_calib.view import CameraView
from rig_protocol.poses import Pose, inverse, transform_points
from support.rendered_rig import RenderedRig
from support.true_optics import first_hits, pixels_of_points, rays_of_pixels

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]
Pair = tuple[int, int]
Sigmas = tuple[Array, Array]
"""Noise (N,) of one coordinate of each match's pixel in the first and in the second camera."""

_TRUE_WITHIN_PX = 3.0  # of where it belongs: what is further off is another thing that looks alike
_SHARED_PATCH_PX = 10.0
_SAME_SURFACE = 0.01  # relative depth by which the other camera may see something else and no occluder


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """N true matches of two cameras: pixels (N,2) and scales (N,) in both, true points (N,3), rig frame.

    `errors` (N,2): the second pixel minus where the point of the first one truly appears.
    """

    pixels: tuple[Array, Array]
    scales_px: tuple[Array, Array]
    points: Array
    errors: Array

    def __len__(self) -> int:
        """How many there are."""
        return len(self.points)


@dataclass(frozen=True, slots=True)
class KeypointNoise:
    """σ² = floor² + (share · scale)² of one coordinate of one keypoint, with the tails of a Student t."""

    floor_px: float
    share: float
    freedom: float

    def sigma_px(self, scale_px: Array | float) -> Array | float:
        """σ of the normal noise that tells as much of a position as this noise does.

        The Fisher information on the centre of a bivariate t is (ν + 2)/(ν + 4)/σ² (Lange, Little &
        Taylor 1989).
        """
        tails = (self.freedom + 4) / (self.freedom + 2)
        return np.sqrt(tails) * np.hypot(self.floor_px, self.share * scale_px)

    def sigmas(self, matches: Matches) -> Sigmas:
        """`sigma_px` of every match's pixels."""
        first, second = (np.asarray(self.sigma_px(scale)) for scale in matches.scales_px)
        return first, second


@dataclass(frozen=True, slots=True, eq=False)
class TrueRig:
    """The truth about a rendered rig."""

    rig: RenderedRig
    scene: Scene
    units: Mapping[int, VirtualUnit]

    @classmethod
    def of(cls, rig: RenderedRig) -> "TrueRig":
        """Drawn again from the settings."""
        units = {i: draw_unit(rig.settings, i) for i in range(rig.settings.cameras)}
        return cls(rig, VirtualRig(rig.settings).scene, units)

    def T_room_color(self, camera: int) -> Pose:
        """Pose of a colour camera in the room."""
        return np.asarray(self.scene.T_room_rig @ self.rig.truth[camera])

    def T_room_depth(self, camera: int) -> Pose:
        """Pose of a depth camera in the room."""
        return np.asarray(self.T_room_color(camera) @ self.units[camera].T_color_depth)


def offered_matches(true: TrueRig) -> dict[Pair, Matches]:
    """Matches of all neighbours."""
    keypoints = {view.camera_id: _detect(view) for view in true.rig.views}
    return {(i, j): _true_matches(true, keypoints, i, j) for i, j in true.rig.settings.overlaps}


def keypoint_noise(matches: Sequence[Matches]) -> KeypointNoise:
    """The noise that the matches' true errors show, by maximum likelihood.

    An error holds the noise of two keypoints of about one scale.
    """
    errors = np.concatenate([one.errors for one in matches])
    scales = np.concatenate([one.scales_px[0] * one.scales_px[1] for one in matches])
    squared = (errors**2).sum(axis=1)

    def cost(parameters: Array) -> float:
        floor, share, freedom = np.exp(parameters)
        variance = 2 * (floor**2 + share**2 * scales)
        tail = (freedom + 2) / 2 * np.log1p(squared / (freedom * variance))
        return float((np.log(variance) + tail).sum())

    best = scipy.optimize.minimize(cost, np.log([0.05, 0.05, 3.0]), method="Nelder-Mead")
    return KeypointNoise(*np.exp(best.x).tolist())


def track_matches(true: TrueRig, scene: TrackScene) -> dict[Pair, Matches]:
    """What an estimator made of the capture: the points that it followed in two neighbours, with true errors.

    Pixels that are known in both directions; of points so near each other that their patches share an error,
    one. Scales of 1, so that all have one noise.
    """
    seen, found = scene.observations, {}
    known = np.flatnonzero(np.isfinite(seen.pixel_sigma))
    for i, j in true.rig.settings.overlaps:
        a, b = (known[seen.camera[known] == scene.cameras.index(c)] for c in (i, j))
        _, first, second = np.intersect1d(seen.point[a], seen.point[b], return_indices=True)
        pixels = seen.pixels[a[first]], seen.pixels[b[second]]
        points, expected = _seen_by_other(true, pixels[0], i, j)
        errors = pixels[1] - expected
        right = np.flatnonzero((np.abs(errors) < _TRUE_WITHIN_PX).all(axis=1))
        right = right[_apart(pixels[0][right], _SHARED_PATCH_PX)]
        ones = np.ones(len(right))
        found[i, j] = Matches(
            (pixels[0][right], pixels[1][right]), (ones, ones), points[right], errors[right]
        )
    return found


@dataclass(frozen=True, eq=False)
class _Keypoints:
    pixels: Array
    scales_px: Array
    descriptors: npt.NDArray[np.float32]

    @cached_property
    def squared(self) -> npt.NDArray[np.float32]:
        return np.asarray((self.descriptors**2).sum(axis=1))


def _detect(view: CameraView) -> _Keypoints:
    grey = np.mean([cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in view.color], axis=0)
    sift = cv2.SIFT.create(enable_precise_upscale=True)
    found, descriptors = sift.detectAndCompute(np.rint(grey).astype(np.uint8), None)
    pixels = np.array([keypoint.pt for keypoint in found]).reshape(-1, 2)
    scales = np.array([keypoint.size / 2 for keypoint in found])
    return _Keypoints(pixels, scales, np.asarray(descriptors, dtype=np.float32))


def _true_matches(true: TrueRig, keypoints: Mapping[int, _Keypoints], i: int, j: int) -> Matches:
    a, b = keypoints[i], keypoints[j]
    points, expected = _seen_by_other(true, a.pixels, i, j)
    back = _seen_by_other(true, b.pixels, j, i)[1]
    rows, columns = (np.flatnonzero(np.isfinite(there[:, 0])) for there in (expected, back))
    if not len(rows) or not len(columns):
        return Matches((np.empty((0, 2)),) * 2, (np.empty(0),) * 2, np.empty((0, 3)), np.empty((0, 2)))
    products = a.descriptors[rows] @ b.descriptors[columns].T
    distance = a.squared[rows][:, None] + b.squared[columns][None] - 2 * products
    nearest = distance.argmin(axis=1)
    mutual = distance.argmin(axis=0)[nearest] == np.arange(len(rows))
    rows, columns = rows[mutual], columns[nearest[mutual]]
    errors = b.pixels[columns] - expected[rows]
    right = (np.abs(errors) < _TRUE_WITHIN_PX).all(axis=1)
    rows, columns, errors = rows[right], columns[right], errors[right]
    once = _one_a_place(a.pixels[rows], b.pixels[columns])
    rows, columns, errors = rows[once], columns[once], errors[once]
    return Matches(
        (a.pixels[rows], b.pixels[columns]), (a.scales_px[rows], b.scales_px[columns]), points[rows], errors
    )


def _seen_by_other(true: TrueRig, pixels: Array, i: int, j: int) -> tuple[Array, Array]:
    """True points (N,3), rig frame, at pixels of camera i, and where j sees them (N,2); NaN = it does not."""
    hits = first_hits(true.scene.surfaces, true.T_room_color(i), rays_of_pixels(true.units[i].color, pixels))
    points = transform_points(true.rig.truth[i], hits.points)
    there = transform_points(inverse(true.rig.truth[j]), points)
    expected = np.full((len(pixels), 2), np.nan)
    ahead = np.flatnonzero((hits.surface >= 0) & (there[:, 2] > 0.1))
    camera = true.units[j].color
    seen = pixels_of_points(camera, there[ahead])
    inside = ((seen >= 0) & (seen <= (camera.width - 1, camera.height - 1))).all(axis=1)
    ahead, seen = ahead[inside], seen[inside]
    rays = there[ahead, :2] / there[ahead, 2:]
    z = first_hits(true.scene.surfaces, true.T_room_color(j), rays).points[:, 2]
    visible = np.abs(z / there[ahead, 2] - 1) < _SAME_SURFACE
    expected[ahead[visible]] = seen[visible]
    return points, expected


def _apart(pixels: Array, distance_px: float) -> Index:
    """Rows of which no two are nearer than a distance; the earlier row stays."""
    dropped: set[int] = set()
    for a, b in sorted(scipy.spatial.KDTree(pixels).query_pairs(distance_px)):
        if a not in dropped:
            dropped.add(b)
    return np.array(sorted(set(range(len(pixels))) - dropped), dtype=np.intp)


def _one_a_place(a: Array, b: Array) -> Index:
    """Rows of which no two share a place in either image: one place described twice has one error."""
    kept = np.arange(len(a))
    for pixels in (a, b):
        _, first = np.unique(np.rint(pixels[kept] * 10), axis=0, return_index=True)
        kept = kept[np.sort(first)]
    return kept
