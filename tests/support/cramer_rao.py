"""How well the poses of a simulated ring can be known at all: the Cramér-Rao bound of one scene.

The measurements are those that the capture offers (`offered_matches`): of every true match two pixels, with
the noise that the truth shows them to have, and at each of them the disparity, as a plane fitted to the
widest window (17, 11 or 7 px) that lies on one surface tells it. The unknowns are all points (no prior); of
every camera its pose (prior: the drawing's tolerance), focal length, centre and k1 of both its cameras,
T_color_depth, the scale of depth and its smooth distortion, each with the spread that the simulator draws it
with. Disparities of neighbouring keypoints share noise; their full covariance enters, with the share that
frames do not average.

It is the linear bound: the covariance of the best linear estimator at the truth, from true second moments
(van Trees for normal priors). An estimator that uses more than these measurements, dense images for example,
may do better. Derivatives are numerical, of a forward model written from the simulator's truth.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy.linalg

from rig_agent.simulator.kinect_noise import noise_sigma_lsb
from rig_agent.simulator.settings import SimulatorSettings
from rig_agent.simulator.units import VirtualUnit
from rig_protocol.camera import Intrinsics
from rig_protocol.frames import NO_DISPARITY
from rig_protocol.poses import Pose, adjoint, inverse, se3_exp, transform_points
from support.disparity_statistics import (
    WINDOW_HALVES_PX,
    distortion_amplitude_lsb,
    distortion_modes,
    window_covariance,
)
from support.offered_matches import Matches, Pair, Sigmas, TrueRig
from support.true_optics import first_hits, pixels_of_points, rays_of_pixels

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

POSE = 6
# One standard deviation of factory values and of k1, as units.py draws them: focal, centre (px), k1.
_FOCAL, _CENTRE_PX = 0.001, 0.6
_T_COLOR_DEPTH = np.repeat([np.deg2rad(0.04), 0.0005], 3)
_ROUNDING_VARIANCE = 1 / 12

_WINDOW_SAMPLES = 5  # an axis, where a window is looked at
_FLAT_LSB = 0.3  # what a window may differ from a plane by
_FILLED = 0.6  # share of a window that must hold measurements
# Of the disparity's variance: modes of the shared noise below this count as white. It moves a bound by 1 %
# and is what makes the computation bearable.
_WHITE_SHARE = 0.3
_STEP = 1e-4  # of the numerical derivatives, in standard deviations


@dataclass(frozen=True, slots=True, eq=False)
class Bound:
    """Least covariance of all poses: `blocks` (C,6,C,6), T_true = T · Exp(δ), rotation first."""

    truth: Mapping[int, Pose]
    blocks: Array

    def relative(self, i: int, j: int) -> Array:
        """Covariance (6,6) of T_i_j on its right."""
        order = sorted(self.truth)
        a, b = order.index(i), order.index(j)
        A = np.zeros((6, len(order), 6))
        A[:, b], A[:, a] = np.eye(6), -adjoint(inverse(self.truth[j]) @ self.truth[i])
        flat = A.reshape(6, -1)
        return np.asarray(flat @ self.blocks.reshape(flat.shape[1], -1) @ flat.T)

    def rmse(self, pairs: Sequence[Pair]) -> tuple[float, float]:
        """Root mean square error over pairs that no estimator is under: degrees, millimetres."""
        covariances = [self.relative(*pair) for pair in pairs]
        turn = np.mean([np.trace(C[:3, :3]) for C in covariances])
        shift = np.mean([np.trace(C[3:, 3:]) for C in covariances])
        return float(np.rad2deg(np.sqrt(turn))), float(1e3 * np.sqrt(shift))


def cramer_rao(true: TrueRig, matches: Mapping[Pair, Matches], sigmas: Mapping[Pair, Sigmas]) -> Bound:
    """The bound of a scene and its frames, from matches and the noise of their pixels."""
    observed = {i: _observe(true, i, matches, sigmas) for i in sorted(true.rig.truth)}
    information = _information(observed, sum(map(len, matches.values())))
    return Bound(true.rig.truth, _pose_covariance(information, observed))


@dataclass(frozen=True, slots=True, eq=False)
class _Observed:
    """One camera's whitened derivatives: by its states (M,3,S) and by the points (M,3,3), and which points.

    Rows: pixel column, pixel row, disparity (zero where there is none). The states are in units of their
    prior standard deviations, those of the pose first, `pose_sigma` (6,), those of the shared noise last.
    """

    point: Index
    by_state: Array
    by_point: Array
    pose_sigma: Array


def _observe(
    true: TrueRig, camera: int, matches: Mapping[Pair, Matches], sigmas: Mapping[Pair, Sigmas]
) -> _Observed:
    point, points, sigma_px = _points_of(camera, matches, sigmas)
    unit, settings = true.units[camera], true.rig.settings
    T = true.rig.truth[camera]
    model = _ForwardModel(unit, T, settings)
    seen = _read_disparity(true, camera, transform_points(inverse(T), points))
    by_state, by_point = _derivatives(model, points, seen)
    by_state[:, :2] /= sigma_px[:, None, None]
    by_point[:, :2] /= sigma_px[:, None, None]
    by_state = np.concatenate([by_state, _shared_noise(seen)], axis=2)
    by_state[:, 2] *= seen.weight[:, None]
    by_point[:, 2] *= seen.weight[:, None]
    return _Observed(point, by_state, by_point, model.sigma[:POSE])


def _points_of(
    camera: int, matches: Mapping[Pair, Matches], sigmas: Mapping[Pair, Sigmas]
) -> tuple[Index, Array, Array]:
    """Numbers (M,), true positions (M,3) and pixel noise (M,) of what a camera sees of all matches."""
    number, points, sigma_px, first = [], [], [], 0
    for pair, found in matches.items():
        if camera in pair:
            number.append(first + np.arange(len(found)))
            points.append(found.points)
            sigma_px.append(sigmas[pair][pair.index(camera)])
        first += len(found)
    return np.concatenate(number), np.concatenate(points), np.concatenate(sigma_px)


# ---- the disparity at a keypoint


@dataclass(frozen=True, slots=True, eq=False)
class _Disparity:
    """Where disparities are read (M,2), the window's half width (M,), the true slope there (M,2), noise (M,).

    `sigma` is that of one pixel's noise that correlates, `weight` (M,) one over that of what does not; 0
    where there is no disparity.
    """

    pixels: Array
    half_px: Index
    slope: Array
    sigma: Array
    weight: Array
    modes: Array


def _read_disparity(true: TrueRig, camera: int, in_color: Array) -> _Disparity:
    unit, settings, frames = true.units[camera], true.rig.settings, len(true.rig.views[0].color)
    in_depth = transform_points(inverse(unit.T_color_depth), in_color)
    pixels = pixels_of_points(unit.depth, in_depth)
    hits = first_hits(true.scene.surfaces, true.T_room_depth(camera), in_depth[:, :2] / in_depth[:, 2:])
    half = _window_halves(true, camera, pixels, hits.planes)
    half[np.abs(hits.points[:, 2] / in_depth[:, 2] - 1) > 0.01] = (
        0  # the depth camera sees something before it
    )
    gradient = hits.planes[:, :2] / (unit.depth.fx, unit.depth.fy)
    normal = hits.planes / np.linalg.norm(hits.planes, axis=1, keepdims=True)
    ray = in_depth / np.linalg.norm(in_depth, axis=1, keepdims=True)
    cosine = np.abs((normal * ray).sum(axis=1))
    sigma = np.asarray(noise_sigma_lsb(settings, unit.raw_model, in_depth[:, 2], cosine), dtype=np.float64)
    sigma *= np.sqrt(settings.frozen_noise + (1 - settings.frozen_noise) / frames)
    disparity = unit.raw_model.offset - unit.raw_model.numerator_m / in_depth[:, 2]
    amplitude = distortion_amplitude_lsb(settings, unit.raw_model, disparity)
    modes = distortion_modes(pixels, (unit.depth.height, unit.depth.width)) * amplitude[:, None]
    known = half > 0
    averaged = np.zeros(len(half))
    for size in WINDOW_HALVES_PX:
        here = half == size
        averaged[here] = sigma[here] * np.sqrt(window_covariance(np.zeros((1, 2)), size, size))
    # What is white of it: rounding, and a small share of the rest so that few modes make up the remainder.
    pixels_a_window = np.maximum((2 * half + 1) ** 2, 1)
    white = _WHITE_SHARE * averaged**2 + _ROUNDING_VARIANCE / frames / pixels_a_window
    weight = np.where(known, 1 / np.sqrt(np.where(known, white, 1)), 0)
    return _Disparity(pixels, half, -unit.raw_model.numerator_m * gradient, sigma, weight, modes)


def _window_halves(true: TrueRig, camera: int, pixels: Array, planes: Array) -> Index:
    """The widest window (M,) around each pixel that is one surface and holds measurements; 0 = none."""
    unit = true.units[camera]
    raw = true.rig.views[camera].raw
    half = np.zeros(len(pixels), dtype=np.intp)
    if not raw:
        return half
    valid = np.asarray(raw[0] != NO_DISPARITY, dtype=np.float64)
    for size in WINDOW_HALVES_PX:
        left = np.flatnonzero(half == 0)
        flat = _is_flat(true, camera, pixels[left], planes[left], size)
        half[left[flat & (_filled(valid, pixels[left], size) >= _FILLED)]] = size
    half[~_inside(unit.depth, pixels)] = 0
    return half


def _inside(camera: Intrinsics, pixels: Array) -> npt.NDArray[np.bool_]:
    return np.asarray(((pixels >= 0) & (pixels <= (camera.width - 1, camera.height - 1))).all(axis=1))


def _is_flat(true: TrueRig, camera: int, pixels: Array, planes: Array, size: int) -> npt.NDArray[np.bool_]:
    unit = true.units[camera]
    steps = np.linspace(-size, size, _WINDOW_SAMPLES)
    around = (pixels[:, None, None] + np.stack(np.meshgrid(steps, steps), axis=-1)).reshape(-1, 2)
    rays = rays_of_pixels(unit.depth, around)
    hits = first_hits(true.scene.surfaces, true.T_room_depth(camera), rays)
    same = np.repeat(planes, _WINDOW_SAMPLES**2, axis=0)
    expected = (same * np.column_stack([rays, np.ones(len(rays))])).sum(axis=1)
    off_lsb = unit.raw_model.numerator_m * np.abs(1 / hits.points[:, 2] - expected)
    return np.asarray((off_lsb.reshape(len(pixels), _WINDOW_SAMPLES**2) < _FLAT_LSB).all(axis=1))


def _filled(valid: Array, pixels: Array, size: int) -> Array:
    """Share (M,) of each window that holds measurements."""
    sums = np.pad(valid, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    middle = np.rint(pixels).astype(int)
    limits = valid.shape[::-1]
    low, high = np.clip(middle - size, 0, limits), np.clip(middle + size + 1, 0, limits)
    inside = sums[high[:, 1], high[:, 0]] - sums[low[:, 1], high[:, 0]]
    inside -= sums[high[:, 1], low[:, 0]] - sums[low[:, 1], low[:, 0]]
    return np.asarray(inside / (2 * size + 1) ** 2)


def _shared_noise(seen: _Disparity) -> Array:
    """Derivatives (M,3,K) by the unit normal modes of the noise that disparities share."""
    known = np.flatnonzero(seen.half_px > 0)
    if not len(known):
        return np.zeros((len(seen.half_px), 3, 0))
    covariance = np.zeros((len(known), len(known)))
    offsets = seen.pixels[known][:, None] - seen.pixels[known][None]
    half = seen.half_px[known]
    for a in WINDOW_HALVES_PX:
        for b in WINDOW_HALVES_PX:
            block = np.ix_(half == a, half == b)
            covariance[block] = window_covariance(offsets[block], a, b)
    white = _WHITE_SHARE * np.diag(covariance) * seen.sigma[known] ** 2
    covariance *= seen.sigma[known][:, None] * seen.sigma[known][None]
    values, vectors = scipy.linalg.eigh(covariance - np.diag(white), driver="evd")
    kept = values > _WHITE_SHARE * np.median(np.diag(covariance))
    modes = np.zeros((len(seen.half_px), 3, int(kept.sum())))
    modes[known, 2] = vectors[:, kept] * np.sqrt(values[kept])
    return modes


# ---- the forward model


@dataclass(frozen=True, slots=True, eq=False)
class _ForwardModel:
    """What a camera measures as a function of its states, in units of their prior standard deviations."""

    unit: VirtualUnit
    T_rig_camera: Pose
    settings: SimulatorSettings

    @property
    def sigma(self) -> Array:
        """Prior standard deviations (S,): pose, colour camera, depth camera, T_color_depth, depth scale."""
        s = self.settings
        lens = [s.factory_error * _FOCAL, *[s.factory_error * _CENTRE_PX] * 2, s.lens_residual_k1]
        mount = np.repeat([np.deg2rad(s.mounting_deg), s.mounting_m], 3)
        return np.concatenate([mount, lens, lens, s.factory_error * _T_COLOR_DEPTH, [s.depth_bias]])

    def measure(self, states: Array, points: Array, seen: _Disparity) -> Array:
        """Column, row and disparity (M,3) of points (M,3), rig frame."""
        x = states * self.sigma
        in_color = transform_points(inverse(self.T_rig_camera @ se3_exp(x[0:6])), points)
        in_depth = transform_points(inverse(self.unit.T_color_depth @ se3_exp(x[14:20])), in_color)
        pixels = pixels_of_points(_changed(self.unit.color, x[6:10]), in_color)
        depth_pixels = pixels_of_points(_changed(self.unit.depth, x[10:14]), in_depth)
        model = self.unit.raw_model
        disparity = model.offset - model.numerator_m * np.exp(x[20]) / in_depth[:, 2]
        # Read at a fixed pixel: the surface's plane leads from there to where the point appears.
        disparity -= (seen.slope * (depth_pixels - seen.pixels)).sum(axis=1)
        return np.column_stack([pixels, disparity])


def _changed(camera: Intrinsics, by: Array) -> Intrinsics:
    k1, *others = camera.dist
    return replace(
        camera,
        fx=camera.fx * np.exp(by[0]),
        fy=camera.fy * np.exp(by[0]),
        cx=camera.cx + by[1],
        cy=camera.cy + by[2],
        dist=(k1 + by[3], *others),
    )


def _derivatives(model: _ForwardModel, points: Array, seen: _Disparity) -> tuple[Array, Array]:
    """Of the measurements, by states and distortion modes (M,3,S) and by points (M,3,3)."""
    size = len(model.sigma)
    rest = np.zeros(size)
    columns = []
    for step in np.eye(size) * _STEP:
        ahead, behind = model.measure(step, points, seen), model.measure(-step, points, seen)
        columns.append((ahead - behind) / (2 * _STEP))
    modes = np.zeros((len(points), 3, seen.modes.shape[1]))
    modes[:, 2] = seen.modes
    by_state = np.concatenate([np.stack(columns, axis=2), modes], axis=2)
    by_point = [
        (model.measure(rest, points + step, seen) - model.measure(rest, points - step, seen)) / (2 * _STEP)
        for step in np.eye(3) * _STEP
    ]
    return by_state, np.stack(by_point, axis=2)


# ---- information


def _information(observed: Mapping[int, _Observed], point_count: int) -> Array:
    """Information on all states (prior included) with the points eliminated, in prior units."""
    on_points = np.zeros((point_count, 3, 3))
    for one in observed.values():
        np.add.at(on_points, one.point, np.einsum("mki,mkj->mij", one.by_point, one.by_point))
    inverse_points = np.linalg.inv(on_points)
    starts = np.cumsum([0, *(one.by_state.shape[2] for one in observed.values())])
    information = np.eye(int(starts[-1]))
    cameras = list(observed.values())
    for a, one in enumerate(cameras):
        for b, other in enumerate(cameras[: a + 1]):
            block = _block(one, other, inverse_points, same=a == b)
            if block is not None:
                here, there = slice(starts[a], starts[a + 1]), slice(starts[b], starts[b + 1])
                information[here, there] += block
                if a != b:
                    information[there, here] += block.T
    return information


def _block(one: _Observed, other: _Observed, inverse_points: Array, *, same: bool) -> Array | None:
    """Information (S,S') between two cameras' states, through the points that both see."""
    _, rows, others = np.intersect1d(one.point, other.point, return_indices=True)
    if not len(rows):
        return None
    through = one.by_point[rows] @ inverse_points[one.point[rows]] @ other.by_point[others].transpose(0, 2, 1)
    weight = np.eye(3) - through if same else -through
    states = (weight @ other.by_state[others]).reshape(3 * len(rows), -1)
    return np.asarray(one.by_state[rows].reshape(3 * len(rows), -1).T @ states)


def _pose_covariance(information: Array, observed: Mapping[int, _Observed]) -> Array:
    """Blocks (C,6,C,6) of the inverse, in radians and metres."""
    starts = np.cumsum([0, *(one.by_state.shape[2] for one in observed.values())])[:-1]
    rows = (starts[:, None] + np.arange(POSE)).ravel()
    unit = np.zeros((len(information), len(rows)))
    unit[rows, np.arange(len(rows))] = 1
    solved = scipy.linalg.cho_solve(scipy.linalg.cho_factor(information, lower=True), unit)[rows]
    sigma = np.concatenate([one.pose_sigma for one in observed.values()])
    blocks = solved * sigma[:, None] * sigma
    return blocks.reshape(len(starts), POSE, len(starts), POSE)
