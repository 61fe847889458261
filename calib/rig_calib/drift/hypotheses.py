"""Which camera's motion explains what the overlaps show."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rig_protocol.poses import Pose, adjoint

Array = npt.NDArray[np.float64]

_VAGUE = np.diag(1 / np.repeat([1.0, 1.0], 3) ** 2)  # nobody moves a camera by 1 rad or 1 m unnoticed
_ALONE, _LEAST_SHARE = 3.0, 0.15
MAX_MOVED = 3
"""So many cameras are looked for; with more moved ones a rig wants a new calibration, not names."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeEvidence:
    """Change of T_i_j seen in one overlap: `delta` (6,), on its right, with covariance (6,6)."""

    i: int
    j: int
    T_j_i: Pose
    delta: Array
    covariance: Array

    def by_motion_of(self, camera: int) -> Array:
        """Derivative (6,6) of `delta` by a camera's motion: δ_ij = δ_j − Ad(T_j_i) δ_i."""
        if camera == self.j:
            return np.eye(6)
        return -adjoint(self.T_j_i) if camera == self.i else np.zeros((6, 6))

    def chi2(self) -> float:
        """Squared distance from no change, in standard deviations."""
        return float(self.delta @ np.linalg.solve(self.covariance, self.delta))

    def without(self, camera: int, motion: Array) -> "EdgeEvidence":
        """What is left when a camera's motion is taken for granted."""
        return replace(self, delta=self.delta - self.by_motion_of(camera) @ motion)


@dataclass(frozen=True, slots=True, eq=False)
class MovedCamera:
    """A motion (6,) of one camera with its covariance (6,6); χ² by which it explains more than no motion.

    `by_edge`: the same, of each of its overlaps.
    `rivals`: cameras whose motion would explain nearly as much.
    """

    camera: int
    delta: Array
    covariance: Array
    chi2: float
    by_edge: tuple[float, ...]
    rivals: tuple[int, ...] = ()

    def is_shown(self, threshold: float) -> bool:
        """Whether all of its overlaps tell of the motion, or the only one very clearly."""
        if len(self.by_edge) < 2:
            return self.chi2 >= _ALONE * threshold
        return self.chi2 >= threshold and min(self.by_edge) >= _LEAST_SHARE * threshold


def moved_cameras(edges: Sequence[EdgeEvidence], threshold: float) -> list[MovedCamera]:
    """Cameras whose motions, one after the other, explain χ² ≥ threshold of the edges.

    A camera that moved is seen in all of its overlaps: where one of two says nothing, the other is wrong. A
    camera at the end of an arc has but one, of which more is asked.
    """
    found: list[MovedCamera] = []
    while len(found) < MAX_MOVED:
        known = {one.camera for one in found}
        cameras = sorted({camera for edge in edges for camera in (edge.i, edge.j)} - known)
        explained = [_explain(edges, camera) for camera in cameras]
        ranked = sorted(filter(lambda one: one.is_shown(threshold), explained), key=lambda one: -one.chi2)
        if not ranked:
            break
        best = ranked[0]
        rivals = tuple(one.camera for one in ranked[1:] if one.chi2 > best.chi2 - 0.5 * threshold)
        found.append(replace(best, rivals=rivals))
        edges = [edge.without(best.camera, best.delta) for edge in edges]
    return found


def support(edges: Iterable[EdgeEvidence], camera: int, motion: Array) -> float:
    """χ² by which a camera's motion explains the edges better than none; negative when they contradict it."""
    return sum(edge.chi2() - edge.without(camera, motion).chi2() for edge in edges)


def _explain(edges: Sequence[EdgeEvidence], camera: int) -> MovedCamera:
    own = [edge for edge in edges if camera in (edge.i, edge.j)]
    information, right = _VAGUE.copy(), np.zeros(6)
    for edge in own:
        A = edge.by_motion_of(camera)
        weighted = A.T @ np.linalg.inv(edge.covariance)
        information += weighted @ A
        right += weighted @ edge.delta
    covariance: Array = np.asarray(np.linalg.inv(information), dtype=np.float64)
    delta = covariance @ right
    by_edge = tuple(support([edge], camera, delta) for edge in own)
    return MovedCamera(camera, delta, covariance, sum(by_edge), by_edge)
