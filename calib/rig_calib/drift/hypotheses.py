"""Which camera's motion explains what the overlaps show."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rig_protocol.poses import Pose, adjoint

Array = npt.NDArray[np.float64]

_VAGUE = np.diag(1 / np.repeat([1.0, 1.0], 3) ** 2)  # nobody moves a camera by 1 rad or 1 m unnoticed
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

    `rivals`: cameras whose motion would explain nearly as much.
    """

    camera: int
    delta: Array
    covariance: Array
    chi2: float
    rivals: tuple[int, ...] = ()


def moved_cameras(edges: Sequence[EdgeEvidence], threshold: float) -> list[MovedCamera]:
    """Cameras whose motions, one after the other, explain the edges; those that explain χ² ≥ threshold."""
    found: list[MovedCamera] = []
    while len(found) < MAX_MOVED:
        known = {one.camera for one in found}
        cameras = sorted({camera for edge in edges for camera in (edge.i, edge.j)} - known)
        ranked = sorted((_explain(edges, camera) for camera in cameras), key=lambda one: -one.chi2)
        if not ranked or ranked[0].chi2 < threshold:
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
    information, right = _VAGUE.copy(), np.zeros(6)
    for edge in edges:
        if camera in (edge.i, edge.j):
            A = edge.by_motion_of(camera)
            weighted = A.T @ np.linalg.inv(edge.covariance)
            information += weighted @ A
            right += weighted @ edge.delta
    covariance: Array = np.asarray(np.linalg.inv(information), dtype=np.float64)
    delta = covariance @ right
    return MovedCamera(camera, delta, covariance, float(right @ delta))
