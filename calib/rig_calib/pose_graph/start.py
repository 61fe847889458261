"""Where an optimisation of a large graph starts: chordal relaxation, which needs no guess.

First all rotations at once by sparse least squares over 3×3 matrices, each then replaced by the nearest
rotation (Martinec & Pajdla, CVPR 2007; Carlone et al., ICRA 2015), then all translations given them.
"""

import numpy as np
import numpy.typing as npt

from rig_calib.pose_graph.block_matrix import BlockPattern
from rig_calib.pose_graph.edge_batch import EdgeBatch

Array = npt.NDArray[np.float64]


def chordal_start(T: Array, edges: EdgeBatch, pattern: BlockPattern) -> Array:
    """Poses (N,4,4) whose free ones follow from the edges and the fixed ones; T gives only the fixed.

    Every part of the graph needs a fixed pose.
    """
    kappa, tau = edges.precisions()
    T = T.copy()
    T[pattern.order] = np.eye(4)
    T[pattern.order, :3, :3] = nearest_rotations(_relaxed_rotations(T, edges, pattern, kappa))
    T[pattern.order, :3, 3] = _translations(T, edges, pattern, tau)
    return T


def nearest_rotations(M: Array) -> Array:
    """The rotation (N,3,3) nearest to each matrix in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(M)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    return np.asarray(U @ Vt)


def _relaxed_rotations(T: Array, edges: EdgeBatch, pattern: BlockPattern, kappa: Array) -> Array:
    """Matrices (F,3,3) of the free nodes that minimise Σ κ ‖R_j − R_i R_ij‖²."""
    R, R_ij = T[:, :3, :3], edges.T_i_j[:, :3, :3]
    weight = kappa[:, None, None]
    blocks = np.broadcast_to(weight * np.eye(3), R_ij.shape)  # also R_ij κ R_ijᵀ
    # The rows of all matrices are independent of each other, so transposed matrices are what is solved for.
    error = weight * (R[edges.j] - R[edges.i] @ R_ij).transpose(0, 2, 1)
    gradient = pattern.vector(-R_ij @ error, error).reshape(-1, 3)
    step = pattern.solve(pattern.matrix(blocks, blocks, -weight * R_ij), -gradient)
    return np.asarray(R[pattern.order] + step.reshape(-1, 3, 3).transpose(0, 2, 1))


def _translations(T: Array, edges: EdgeBatch, pattern: BlockPattern, tau: Array) -> Array:
    """Translations (F,3) of the free nodes that minimise Σ τ ‖t_j − t_i − R_i t_ij‖²."""
    R, t = T[:, :3, :3], T[:, :3, 3]
    weight = tau[:, None, None]
    reach = (R[edges.i] @ edges.T_i_j[:, :3, 3:])[..., 0]
    error = tau[:, None] * (t[edges.j] - t[edges.i] - reach)
    step = pattern.solve(pattern.matrix(weight, weight, -weight), -pattern.vector(-error, error))
    return np.asarray(t[pattern.order] + step)
