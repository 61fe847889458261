"""The joint estimate: poses, points and what is wrong with every camera in one adjustment, on patches.

Keypoints start it. Then patches are looked for where the poses predict them, and again while the poses move;
where a pair is left that is known too little, walls and floor that cameras share join them.
Pairs that only the drawing predicts are led by depth first, with noise that goes down to what it is.
"""

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from rig_calib.bundle_adjustment import ROUGHLY_CONVERGED
from rig_calib.edges import TOLERANCE, Edge, estimate_edge
from rig_calib.matching import Matches
from rig_calib.noise import NoiseModel
from rig_calib.observed_camera import ObservedCamera
from rig_calib.overlap import Region
from rig_calib.parallel import in_threads
from rig_calib.refinement import RefinedRig, refine
from rig_calib.registration import ransac
from rig_calib.rig_adjustment import AT_REST, AdjustedRig, adjust_rig
from rig_calib.settings import CalibrationSettings
from rig_calib.shared_planes import NOTHING_SHARED, find_shared_planes
from rig_calib.uncertainty import weakest_direction
from rig_protocol.poses import Pose, inverse, rotation_angle_deg
from rig_protocol.rig_folder import RingDrawing

Pair = tuple[int, int]

# Rough, to judge how far a prediction may be off.
_FOCAL_PX, _NEAR_WALL_M = 525.0, 1.5
# Patches are looked for again while poses move by more than a patch's alignment makes up for.
_MAX_ROUNDS, _SETTLED_PX = 9, 6.0
_DEPTH_ROUNDS = 4  # of pairs that nothing but the drawing predicts
# What is far off must not count as an outlier at once: noise goes down to what it is.
_GRADUATED_NOISE = tuple(
    NoiseModel(pixel_distortion=pixels, disparity_distortion=steps)
    for pixels, steps in ((1.0, 4.0), (1.0, 2.0), (1.0, 1.0), (1.0, 0.5), (1.0, 0.3), (0.3, 0.15))
)
_FAR_AND_WIDE_PX = 4.0  # predictions worse than this find false places, too
# This share of what has texture must look alike in the other camera, or the place is a wrong one: 0.30-0.60
# was seen there, 0.66-0.93 at right places (simulated rooms without patterns).
_LEAST_FOUND_SHARE = 0.63
# Fewer patches that were found far from where the drawing has them may agree by chance.
_MIN_PATCHES = 20
_NO_MATCHES: Matches = np.empty((0, 2), dtype=np.intp)


@dataclass(frozen=True, slots=True, eq=False)
class JointEstimate:
    """The adjusted rig, the cameras with patches for keypoints, and every pair judged by its own patches."""

    rig: AdjustedRig
    cameras: Mapping[int, ObservedCamera]
    edges: tuple[Edge, ...]


def estimate_jointly(
    cameras: Mapping[int, ObservedCamera],
    regions: Mapping[Pair, tuple[Region, Region]],
    edges: Sequence[Edge],
    start: Mapping[int, Pose],
    ring: RingDrawing | None,
    settings: CalibrationSettings,
) -> JointEstimate | None:
    """Adjust on the keypoints of `edges` that are believed, then on patches; None without two start poses.

    With a drawing, cameras that no keypoint connects start from there.
    """
    if ring is not None:
        start = _drawn(cameras) | dict(start)
    if len(start) < 2:
        return None
    keypoint_matches = {edge.pair: edge.agreeing_matches for edge in edges if edge.reason is None}
    rig = adjust_rig(cameras, keypoint_matches, start, ring, settings, converged=ROUGHLY_CONVERGED)
    far = {pair for pair, px in _prediction_px(rig, regions).items() if px > _FAR_AND_WIDE_PX}
    noise = AT_REST
    believed = dict(regions)
    for k in range(_MAX_ROUNDS):
        before, prediction_px = rig.poses, _prediction_px(rig, regions)
        depth_only = far if k < _DEPTH_ROUNDS else set()
        refined = refine(
            cameras, believed, before, rig.corrections, prediction_px, depth_only, keypoint_matches
        )
        for pair in _misplaced(refined, far - depth_only):
            del believed[pair], refined.matches[pair]
        matches = _verified(refined, far - depth_only, prediction_px, settings)
        graduated = bool(far) and k < len(_GRADUATED_NOISE)
        assumed = _GRADUATED_NOISE[k] if graduated else noise
        rig = adjust_rig(refined.cameras, matches, before, ring, settings, assumed, rig.states)
        if not graduated:
            noise = rig.observed_noise()
            if _largest_shift_px(before, rig.poses, regions) < _SETTLED_PX:
                break
    shared = NOTHING_SHARED
    if _any_weak(rig, regions, settings):
        shared = find_shared_planes(cameras, rig.scene.cameras, rig.adjustment)
    if noise.differs_from(rig.noise) or len(shared.planes):
        rig = adjust_rig(refined.cameras, matches, rig.poses, ring, settings, noise, rig.states, shared)
    judged = in_threads(lambda edge: _refined_edge(edge, refined, matches, rig, settings), edges)
    return JointEstimate(rig, refined.cameras, tuple(judged))


def _drawn(cameras: Mapping[int, ObservedCamera]) -> dict[int, Pose]:
    """Where the drawing has the cameras that it knows."""
    nominal = {c: camera.view.T_rig_nominal for c, camera in cameras.items()}
    return {c: T for c, T in nominal.items() if T is not None}


def _verified(
    refined: RefinedRig, far: Set[Pair], prediction_px: Mapping[Pair, float], settings: CalibrationSettings
) -> dict[Pair, Matches]:
    """The pairs' patches; of those that were looked for far and wide only what agrees on one pose.

    A pair that only the drawing predicted and that has no texture in common gets nothing: two bare walls look
    alike from many places.
    """
    out = {}
    for (i, j), rows in refined.matches.items():
        a, b = refined.cameras[i], refined.cameras[j]
        textured = a.keypoints.has_place[rows[:, 0]] & b.keypoints.has_place[rows[:, 1]]
        agreed = rows[textured]
        if prediction_px[i, j] > _FAR_AND_WIDE_PX:
            sides = a.side(agreed[:, 0]), b.side(agreed[:, 1])
            rng = np.random.default_rng([settings.seed, i, j])
            found = ransac(*sides, TOLERANCE, rng, settings.min_inliers)
            agreed = agreed[found[1]] if found is not None else _NO_MATCHES
        bare = (i, j) in far and len(agreed) < _MIN_PATCHES
        out[i, j] = _NO_MATCHES if bare else np.concatenate([agreed, rows[~textured]])
    return out


def _misplaced(refined: RefinedRig, far: Set[Pair]) -> set[Pair]:
    """Pairs that only the drawing predicted and whose textures do not look alike where their depth does."""
    return {
        pair for pair in far & refined.found_share.keys() if refined.found_share[pair] < _LEAST_FOUND_SHARE
    }


def _largest_shift_px(before: Mapping[int, Pose], after: Mapping[int, Pose], pairs: Iterable[Pair]) -> float:
    """By how many pixels predictions changed, at most."""
    shifts = [0.0]
    for i, j in pairs:
        if i in after and j in after:
            T = inverse(inverse(before[i]) @ before[j]) @ inverse(after[i]) @ after[j]
            turn_rad = np.deg2rad(rotation_angle_deg(T))
            shifts.append(_FOCAL_PX * float(np.hypot(turn_rad, np.linalg.norm(T[:3, 3]) / _NEAR_WALL_M)))
    return max(shifts)


def _refined_edge(
    edge: Edge,
    refined: RefinedRig,
    matches: Mapping[Pair, Matches],
    rig: AdjustedRig,
    settings: CalibrationSettings,
) -> Edge:
    """What the pair's patches alone say; without any it keeps why its keypoints gave nothing."""
    i, j = edge.pair
    rows = matches.get(edge.pair, _NO_MATCHES)
    if not len(rows):
        reason = edge.reason or "nothing that both cameras recognise was left when depth was corrected"
        return replace(edge, matches=_NO_MATCHES, inlier=np.zeros(0, dtype=bool), reason=reason)
    T_i_j = inverse(rig.poses[i]) @ rig.poses[j]
    return estimate_edge(refined.cameras[i], refined.cameras[j], rows, T_i_j, settings, rig.states)


def _any_weak(rig: AdjustedRig, pairs: Iterable[Pair], settings: CalibrationSettings) -> bool:
    """Whether the gate would refuse a pair: only there do shared planes know more than patches do."""
    sigmas = [weakest_direction(rig.relative(i, j)[1]) for i, j in pairs if i in rig.poses and j in rig.poses]
    limits = settings.max_pair_sigma_deg, settings.max_pair_sigma_m
    return any(deg > limits[0] or metres > limits[1] for deg, metres in sigmas)


def _prediction_px(rig: AdjustedRig, pairs: Iterable[Pair]) -> dict[Pair, float]:
    """Standard deviation, in pixels, of where the poses put one camera's points in another."""
    out = {}
    for i, j in pairs:
        if i in rig.poses and j in rig.poses:
            sigma_deg, sigma_m = weakest_direction(rig.relative(i, j)[1])
            out[i, j] = _FOCAL_PX * float(np.hypot(np.deg2rad(sigma_deg), sigma_m / _NEAR_WALL_M))
    return out
