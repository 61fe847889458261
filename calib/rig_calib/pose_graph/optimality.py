"""Is an optimum of the chordal objective the global one? A lower bound by duality (Rosen et al., IJRR 2019).

With X = [R_1 t_1 R_2 t_2 …] (3 × 4N) and Ω = diag(κ, κ, κ, τ) the objective is the sum over the edges of
tr (X_j − X_i T_ij) Ω (X_j − X_i T_ij)ᵀ, thus tr X M Xᵀ. RᵀR = I for every pose, so for any symmetric
Λ_i (3 × 3) the objective of any poses Y is Σ tr Λ_i + tr Y S Yᵀ with S = M − Λ. If S, its translations
eliminated, has no eigenvalue below λ ≤ 0, that is at least Σ tr Λ_i + 3 N λ. At a stationary X the choice
Λ_i = sym(R_iᵀ (X M)_i) makes Σ tr Λ_i the objective of X, and S X = 0: where λ = 0, X is a global optimum.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse.linalg

from rig_calib.pose_graph.block_matrix import BlockPattern, Matrix, factorised
from rig_calib.pose_graph.edge_batch import EdgeBatch

Array = npt.NDArray[np.float64]

_CERTIFIED_GAP = 1e-3
_SETTLED = 1e-3  # an objective below this for each edge: nothing better is worth finding
_ROUNDING = 1e-12  # of the matrix's largest entry: no eigenvalue is known better
_MAX_OPERATIONS = 4e9  # of a factorisation; above, the check would take longer than the optimisation
_SHIFT_GROWTH, _MAX_SHIFTS = 30.0, 20


@dataclass(frozen=True, slots=True)
class Certificate:
    """What is known of the chordal objective Σ κ‖R_j − R_i R_ij‖² + τ‖t_j − t_i − R_i t_ij‖² of some poses.

    No poses can undercut `lower_bound`; `eigenvalue` is the smallest of the certificate matrix, zero but for
    rounding at a global optimum. `gap` is relative to the objective. All None where the graph is too large.
    """

    objective: float
    lower_bound: float | None = None
    eigenvalue: float | None = None
    gap: float | None = None

    @property
    def certified(self) -> bool:
        """True when the bound shows that no poses are better by more than a thousandth."""
        return self.gap is not None and self.gap <= _CERTIFIED_GAP


def certify(T: Array, edges: EdgeBatch) -> Certificate:
    """Certificate of poses T (N,4,4), which should be a minimum of the chordal objective.

    The bound holds for all poses; should several be fixed in one part of the graph, it may be loose.
    """
    objective = float(edges.isotropic().squared_distances(T, "chordal").sum())
    pattern = BlockPattern(edges.i, edges.j, np.ones(len(T), dtype=bool))
    if pattern.operations(4) > _MAX_OPERATIONS:
        return Certificate(objective)
    S, dual = _certificate_matrix(T, edges, pattern)
    largest = float(np.abs(S if isinstance(S, np.ndarray) else S.data).max(initial=0.0))
    scale = max(objective, _SETTLED * len(edges))
    resolution = max(0.1 * _CERTIFIED_GAP * scale / (3 * len(T)), _ROUNDING * largest)
    eigenvalue = _smallest_eigenvalue(S, pattern, resolution)
    lower_bound = max(dual + 3 * len(T) * min(eigenvalue, 0.0), 0.0)
    return Certificate(objective, lower_bound, eigenvalue, max(objective - lower_bound, 0.0) / scale)


def _certificate_matrix(T: Array, edges: EdgeBatch, pattern: BlockPattern) -> tuple[Matrix, float]:
    """S and Σ tr Λ_i. One translation of each part may be taken as zero, so weight on it does no harm."""
    _, anchors = np.unique(edges.parts(len(T)), return_index=True)
    kappa, tau = edges.precisions()
    omega = np.stack([kappa, kappa, kappa, tau], axis=1)[:, :, None] * np.eye(4)
    X_transposed = T[:, :3].transpose(0, 2, 1)
    T_ji = edges.T_i_j.transpose(0, 2, 1)
    error = omega @ (X_transposed[edges.j] - T_ji @ X_transposed[edges.i])
    MX = pattern.vector(-edges.T_i_j @ error, error)
    multipliers = MX[:, :3] @ T[pattern.order, :3, :3]
    own = np.zeros((len(T), 4, 4))
    own[:, :3, :3] = -0.5 * (multipliers + multipliers.transpose(0, 2, 1))
    own[np.isin(pattern.order, anchors), 3, 3] += tau.max(initial=0.0)
    S = pattern.matrix(edges.T_i_j @ omega @ T_ji, omega, -edges.T_i_j @ omega, own)
    return S, float(np.trace(multipliers, axis1=1, axis2=2).sum())


def _smallest_eigenvalue(S: Matrix, pattern: BlockPattern, resolution: float) -> float:
    """Smallest eigenvalue of S with the translations eliminated; −inf if that cannot be told.

    S + shift on the rotations is positive definite just when none lies below −shift. The smallest such shift
    that is tried is then where Lanczos iterations on the inverse start.
    """
    shift, rotations = resolution, np.tile([True, True, True, False], pattern.count)
    factors = None
    for _ in range(_MAX_SHIFTS):
        factors = _positive_factors(pattern.shifted(S, 0.0, np.array([shift, shift, shift, 0.0])))
        if factors is not None:
            break
        shift *= _SHIFT_GROWTH
    if factors is None:
        return -np.inf

    def inverse(v: Array) -> Array:
        full = np.zeros(len(rotations))
        full[rotations] = v.ravel()
        return np.asarray(factors.solve(full)[rotations])

    size = int(rotations.sum())
    operator = scipy.sparse.linalg.LinearOperator((size, size), matvec=inverse, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(size)
    # Exact enough: an error of a thousandth in the inverse is one of a thousandth of the shift.
    largest = scipy.sparse.linalg.eigsh(
        operator, k=1, which="LA", v0=start, tol=1e-3, return_eigenvectors=False
    )
    return float(1.0 / largest[0] - shift)


def _positive_factors(matrix: Matrix) -> scipy.sparse.linalg.SuperLU | None:
    """Factors of a positive definite matrix, None for any other."""
    try:
        factors = factorised(matrix)
    except np.linalg.LinAlgError:
        return None
    return factors if (factors.U.diagonal() > 0.0).all() else None
