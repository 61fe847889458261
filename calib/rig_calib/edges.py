"""Edges: what one pair of cameras says of its relative pose, and whether that fixes all six degrees."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from rig_calib.bundle_adjustment import ROUGHLY_CONVERGED
from rig_calib.matching import Matches
from rig_calib.observation_model import CameraState
from rig_calib.observed_camera import ObservedCamera
from rig_calib.registration import Tolerance, agreeing, minimise_distances, ransac
from rig_calib.rig_adjustment import adjust_rig
from rig_calib.settings import CalibrationSettings
from rig_calib.uncertainty import weakest_direction
from rig_protocol.poses import Pose, adjoint, inverse, transform_points

Array = npt.NDArray[np.float64]

TOLERANCE = Tolerance()
# What a percent of depth bias, which the scatter does not show, does to a plain alignment.
_BIAS_SIGMA = np.repeat([np.deg2rad(0.4), 0.02], 3)


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """One pair's matches (N,2), which of them agree, and the relative pose they give with its covariance.

    `T_i_j` is None when no pose explains enough matches. `reason` says why the edge is not used, else None.
    """

    i: int
    j: int
    matches: Matches
    inlier: npt.NDArray[np.bool_]
    T_i_j: Pose | None = None
    covariance: Array | None = None
    rms_mm: float = 0.0
    reason: str | None = None

    @property
    def pair(self) -> tuple[int, int]:
        """Ids of the two cameras."""
        return self.i, self.j

    @property
    def agreeing_matches(self) -> Matches:
        """The matches (K,2) that agree with the edge's pose."""
        return self.matches[self.inlier]

    def refused(self, reason: str) -> "Edge":
        """The same edge, not to be used."""
        return replace(self, reason=reason)


def measure_edge(
    i: ObservedCamera, j: ObservedCamera, matches: Matches, settings: CalibrationSettings
) -> Edge:
    """Relative pose of two cameras from their matches alone: RANSAC, then the method's own estimate."""
    ids = (i.view.camera_id, j.view.camera_id)
    sides = i.side(matches[:, 0]), j.side(matches[:, 1])
    rng = np.random.default_rng([settings.seed, *ids])
    found = ransac(*sides, TOLERANCE, rng, settings.min_inliers)
    if found is None:
        nothing = np.zeros(len(matches), dtype=bool)
        return Edge(*ids, matches, nothing, reason=_unsupported(len(matches), settings))
    return estimate_edge(i, j, matches, found[0], settings)


def estimate_edge(
    i: ObservedCamera,
    j: ObservedCamera,
    matches: Matches,
    start: Pose,
    settings: CalibrationSettings,
    states: Mapping[int, CameraState] = MappingProxyType({}),
) -> Edge:
    """The method's estimate of T_i_j from a start, and the test of its support.

    `states` are what else is known of the two cameras, to start from.
    """
    ids = (i.view.camera_id, j.view.camera_id)
    inlier = agreeing(start, i.side(matches[:, 0]), j.side(matches[:, 1]), TOLERANCE)
    both = i.depth.known[matches[:, 0]] & j.depth.known[matches[:, 1]] & inlier
    if inlier.sum() < settings.min_inliers or (settings.method == "paper" and both.sum() < 3):
        return Edge(*ids, matches, inlier, reason=_unsupported(len(matches), settings))
    p_i, p_j = i.points[matches[both, 0]], j.points[matches[both, 1]]
    if settings.method == "paper":
        T_i_j, covariance = _paper_estimate(p_i, p_j, start)
    else:
        poses = {ids[0]: np.eye(4), ids[1]: start}
        pair = adjust_rig(
            {ids[0]: i, ids[1]: j},
            {ids: matches[inlier]},
            poses,
            None,
            settings,
            states=states,
            converged=ROUGHLY_CONVERGED,
        )
        T_i_j, covariance = pair.relative(*ids)
    squared_m = ((p_i - transform_points(T_i_j, p_j)) ** 2).sum(axis=1)
    rms_mm = float(np.sqrt(squared_m.mean()) * 1e3) if len(squared_m) else 0.0
    edge = Edge(*ids, matches, inlier, T_i_j, covariance, rms_mm)
    weakness = _weakness(covariance, settings)
    return edge if weakness is None else edge.refused(weakness)


def _paper_estimate(p_i: Array, p_j: Array, start: Pose) -> tuple[Pose, Array]:
    """Eq. 4 and 5, with the covariance that scatter and common depth bias suggest, on the right of T_i_j."""
    T_i_j, normal = minimise_distances(p_i, p_j, start)
    variance = float(((p_i - transform_points(T_i_j, p_j)) ** 2).sum() / max(3 * len(p_i) - 6, 1))
    left = variance * np.linalg.inv(normal + 1e-9 * np.eye(6))
    Ad = adjoint(inverse(T_i_j))
    return T_i_j, np.asarray(Ad @ left @ Ad.T + np.diag(_BIAS_SIGMA**2))


def _weakness(covariance: Array, settings: CalibrationSettings) -> str | None:
    """What the matches leave open, or None when all six degrees of freedom are fixed well enough."""
    sigma_deg, sigma_m = weakest_direction(covariance)
    if sigma_deg <= settings.max_edge_sigma_deg and sigma_m <= settings.max_edge_sigma_m:
        return None
    return (
        f"the matches leave a direction open (standard deviation {sigma_deg:.1f}°, {sigma_m * 1e3:.0f} mm): "
        "they lie on a line, in a corner, or are too few"
    )


def _unsupported(count: int, settings: CalibrationSettings) -> str:
    return f"of {count} matches fewer than {settings.min_inliers} agree on one pose"
