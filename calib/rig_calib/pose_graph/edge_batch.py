"""All edges of a pose graph as arrays, and what they measure at given poses, under two objectives.

Poses are a stack (N,4,4); edges name rows of it. An edge's error pose is E = T_i_j⁻¹ T_i⁻¹ T_j.

geodesic  r = Log E with the full 6×6 information: eq. 6 of the paper.
chordal   r = (2 sin(θ/2) · axis, translation) of E. With `isotropic` information, Σ rᵀ Λ r is
          Σ κ ‖R_j − R_i R_ij‖² + τ ‖t_j − t_i − R_i t_ij‖², a quadratic form of the matrices whose
          global optimum can be certified (Rosen et al., "SE-Sync", IJRR 2019).

The cost is ½ Σ rᵀ Λ r for both.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy.sparse
import scipy.sparse.csgraph

from rig_calib.pose_graph.graph import PoseEdge
from rig_calib.pose_graph.se3_batches import (
    adjoints,
    inverse_right_jacobians,
    inverses,
    logarithms,
)
from rig_calib.rotations import quaternions
from rig_protocol.poses import Pose, hat

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]
Objective = Literal["geodesic", "chordal"]

_SIMILAR_AXES, _WEAK_CORRELATION = 10.0, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class EdgeBatch:
    """M edges: rows `i`, `j` (M,) of the pose stack, T_i_j (M,4,4), information (M,6,6), rotation first."""

    i: Index
    j: Index
    T_i_j: Array
    information: Array

    @classmethod
    def of(cls, edges: Sequence[PoseEdge], row: Mapping[int, int]) -> "EdgeBatch":
        """Edges whose nodes stand in these rows of the stack."""
        count = len(edges)
        return cls(
            np.fromiter((row[edge.i] for edge in edges), np.intp, count),
            np.fromiter((row[edge.j] for edge in edges), np.intp, count),
            np.array([edge.T_i_j for edge in edges], dtype=np.float64).reshape(count, 4, 4),
            np.array([edge.information for edge in edges], dtype=np.float64).reshape(count, 6, 6),
        )

    def __len__(self) -> int:
        return len(self.i)

    def select(self, rows: Index | npt.NDArray[np.bool_]) -> "EdgeBatch":
        """The same arrays with fewer edges."""
        return EdgeBatch(self.i[rows], self.j[rows], self.T_i_j[rows], self.information[rows])

    def weighted(self, weights: Array) -> "EdgeBatch":
        """Every edge's information times its weight (M,)."""
        return replace(self, information=self.information * weights[:, None, None])

    def isotropic(self) -> "EdgeBatch":
        """Every information replaced by diag(2κ, 2κ, 2κ, τ, τ, τ): what SE-Sync takes from it."""
        kappa, tau = self.precisions()
        diagonal = np.repeat(np.stack([2.0 * kappa, tau], axis=1), 3, axis=1)
        return replace(self, information=diagonal[:, :, None] * np.eye(6))

    def precisions(self) -> tuple[Array, Array]:
        """κ = 3 / (2 tr Λ_R⁻¹) and τ = 3 / tr Λ_t⁻¹ of every edge (SE-Sync's, for rotation vectors)."""
        rotation, translation = (
            np.trace(np.linalg.inv(self.information[:, block, block]), axis1=1, axis2=2)
            for block in (slice(0, 3), slice(3, 6))
        )
        return 1.5 / rotation, 3.0 / translation

    def parts(self, count: int) -> Index:
        """Which connected part of the graph each of its `count` nodes belongs to, by number."""
        links = scipy.sparse.coo_array((np.ones(len(self)), (self.i, self.j)), shape=(count, count))
        return np.asarray(scipy.sparse.csgraph.connected_components(links, directed=False)[1], dtype=np.intp)

    def nearly_isotropic(self) -> bool:
        """True when little is lost by κ and τ alone: no axis ten times another, no strong correlation."""
        root = np.linalg.cholesky(self.information)
        blocks = self.information[:, :3, :3], self.information[:, 3:, 3:]
        for block in blocks:
            axes = np.linalg.eigvalsh(block)
            if (axes[:, 2] > _SIMILAR_AXES * axes[:, 0]).any():
                return False
        # Λ_tR Λ_R⁻¹ Λ_Rt is what the rotation's error explains of the translation's information.
        explained = root[:, 3:, :3] @ root[:, 3:, :3].transpose(0, 2, 1)
        share = np.trace(np.linalg.solve(blocks[1], explained), axis1=1, axis2=2)
        return bool((share <= _WEAK_CORRELATION**2).all())

    def error_poses(self, T: Array) -> Array:
        """E (M,4,4) at poses T (N,4,4)."""
        return np.asarray(inverses(T[self.i] @ self.T_i_j) @ T[self.j])

    def residuals(self, T: Array, objective: Objective) -> Array:
        """r (M,6) at poses T (N,4,4)."""
        E = self.error_poses(T)
        return logarithms(E) if objective == "geodesic" else _chordal(E)

    def squared_distances(self, T: Array, objective: Objective) -> Array:
        """rᵀ Λ r (M,) at poses T (N,4,4)."""
        r = self.residuals(T, objective)
        return np.asarray(((self.information @ r[..., None])[..., 0] * r).sum(axis=1))

    def linearised(self, T: Array, objective: Objective) -> "LinearisedEdges":
        """The edges' parts of the normal equations of ½ Σ rᵀ Λ r for steps T · Exp(δ)."""
        r = self.residuals(T, objective)
        by_j = inverse_right_jacobians(r) if objective == "geodesic" else _chordal_jacobians(self, T)
        weighted = by_j.transpose(0, 2, 1) @ self.information
        minus_Ad = -adjoints(inverses(T[self.j]) @ T[self.i]).transpose(0, 2, 1)
        jj, j = weighted @ by_j, weighted @ r[..., None]
        ij = minus_Ad @ jj
        return LinearisedEdges(
            ii=ij @ minus_Ad.transpose(0, 2, 1), jj=jj, ij=ij, i=(minus_Ad @ j)[..., 0], j=j[..., 0]
        )


@dataclass(frozen=True, slots=True, eq=False)
class LinearisedEdges:
    """Every edge's blocks (M,B,B) of the normal matrix, and its gradients (M,B) by its two poses."""

    ii: Array
    jj: Array
    ij: Array
    i: Array
    j: Array


def squared_distances(edges: Sequence[PoseEdge], poses: Mapping[int, Pose]) -> Array:
    """rᵀ Λ r (M,) of every edge under given poses: χ² of six degrees of freedom where the edge is right."""
    row = {node: k for k, node in enumerate(poses)}
    T = np.array(list(poses.values()), dtype=np.float64).reshape(-1, 4, 4)
    return EdgeBatch.of(edges, row).squared_distances(T, "geodesic")


def _chordal(E: Array) -> Array:
    return np.concatenate([2.0 * quaternions(E[:, :3, :3])[:, 1:], E[:, :3, 3]], axis=1)


def _chordal_jacobians(batch: EdgeBatch, T: Array) -> Array:
    """d r / dε (M,6,6) of E · Exp(ε)."""
    E = batch.error_poses(T)
    q = quaternions(E[:, :3, :3])
    J = np.zeros((len(E), 6, 6))
    J[:, :3, :3] = q[:, 0, None, None] * np.eye(3) + hat(q[:, 1:])
    J[:, 3:, 3:] = E[:, :3, :3]
    return J
