"""Symmetric matrices of B×B blocks, one block row a free node of a graph, and their solution.

Small ones are dense, sparse ones are factorised in minimum-degree order. Where loops make the factors fill
up, the graph is well connected and conjugate gradients converge quickly: they take over.
"""

import numpy as np
import numpy.typing as npt
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]
Matrix = Array | scipy.sparse.bsr_array

_DENSE_NODES = 60
# Multiplications of a factorisation (two seconds or so) above which conjugate gradients are quicker.
_MAX_OPERATIONS = 8e9
_CG_TOLERANCE, _CG_ITERATIONS = 1e-4, 500


class BlockPattern:
    """Which blocks the edges between nodes i and j (M,) fill; `free` (N,) says which nodes have a row.

    `order` lists the free nodes by block row: ascending, or as the factorisation wants them.
    """

    def __init__(self, i: Index, j: Index, free: npt.NDArray[np.bool_]) -> None:
        self.order = np.flatnonzero(free)
        self._elimination_cost = 0.0
        if not self._dense:
            a, b = self._places(free)[[i, j]]
            elimination, self._elimination_cost = _elimination_order(a, b, self.count)
            self.order = self.order[elimination]
        self._a, self._b = self._places(free)[[i, j]]
        self._sort_blocks()

    @property
    def count(self) -> int:
        """Number of free nodes."""
        return len(self.order)

    def matrix(self, ii: Array, jj: Array, ij: Array, own: Array | None = None) -> Matrix:
        """The sum of the edges' blocks (M,B,B), each in its four places, and of `own` (count,B,B)."""
        size = ii.shape[1]
        across = ij[self._within]
        own = np.zeros((self.count, size, size)) if own is None else own
        parts = [own, ii[self._from_i], jj[self._from_j], across, across.transpose(0, 2, 1)]
        data = np.concatenate(parts)[self._by_block]
        data = np.add.reduceat(data, self._first) if self.count else data
        full = self.count * size
        if not self._dense:
            return scipy.sparse.bsr_array((data, self._columns, self._row_starts), shape=(full, full))
        dense = np.zeros((self.count, size, self.count, size))
        dense[self._rows, :, self._columns, :] = data
        return dense.reshape(full, full)

    def vector(self, i: Array, j: Array) -> Array:
        """The sum of the edges' parts (M,...) by free node, (count,...)."""
        out = np.zeros((self.count, *i.shape[1:]))
        np.add.at(out, self._a[self._from_i], i[self._from_i])
        np.add.at(out, self._b[self._from_j], j[self._from_j])
        return out

    def shifted(self, matrix: Matrix, relative: float, absolute: Array) -> Matrix:
        """The matrix with its diagonal d replaced by d + relative · d + absolute (B,)."""
        size = len(absolute)
        if isinstance(matrix, np.ndarray):
            shifted = matrix.copy()
            shifted.ravel()[:: len(matrix) + 1] += relative * matrix.diagonal() + np.tile(
                absolute, self.count
            )
            return shifted
        copied = matrix.copy()
        corner = np.arange(size)
        diagonal = copied.data[self._diagonal][:, corner, corner]
        copied.data[self._diagonal[:, None], corner, corner] = diagonal * (1.0 + relative) + absolute
        return copied

    def solve(self, matrix: Matrix, right: Array) -> Array:
        """x with matrix · x = right, (count·B,) or (count·B,K), the matrix being positive definite.

        LinAlgError when it is singular.
        """
        if isinstance(matrix, np.ndarray):
            factor = scipy.linalg.cho_factor(matrix, check_finite=False)
            return np.asarray(scipy.linalg.cho_solve(factor, right, check_finite=False))
        if self.operations(matrix.blocksize[0]) <= _MAX_OPERATIONS:
            return np.asarray(factorised(matrix).solve(right))
        return self._conjugate_gradients(matrix, right)

    def operations(self, block_size: int) -> float:
        """Multiplications of one sparse factorisation, about."""
        return self._elimination_cost * block_size**3

    @property
    def _dense(self) -> bool:
        return self.count <= _DENSE_NODES

    def _places(self, free: npt.NDArray[np.bool_]) -> Index:
        """Block row of every node, −1 for a fixed one."""
        places = np.full(len(free), -1)
        places[self.order] = np.arange(self.count)
        return places

    def _sort_blocks(self) -> None:
        """Where the blocks of all edges go: sorted by row and column, those of one place are summed."""
        self._from_i, self._from_j = np.flatnonzero(self._a >= 0), np.flatnonzero(self._b >= 0)
        self._within = np.flatnonzero((self._a >= 0) & (self._b >= 0))
        own, a, b = np.arange(self.count), self._a[self._within], self._b[self._within]
        diagonal = [own, self._a[self._from_i], self._b[self._from_j]]
        key = np.concatenate([*diagonal, a, b]) * self.count + np.concatenate([*diagonal, b, a])
        self._by_block = np.argsort(key, kind="stable")
        filled, self._first = np.unique(key[self._by_block], return_index=True)
        self._rows, self._columns = np.divmod(filled, max(self.count, 1))
        self._row_starts = np.searchsorted(self._rows, np.arange(self.count + 1))
        self._diagonal = np.flatnonzero(self._rows == self._columns)

    def _conjugate_gradients(self, matrix: scipy.sparse.bsr_array, right: Array) -> Array:
        size = matrix.blocksize[0]
        inverse = np.linalg.inv(matrix.data[self._diagonal])

        def precondition(v: Array) -> Array:
            return np.asarray((inverse @ v.reshape(-1, size, 1)).ravel())

        M = scipy.sparse.linalg.LinearOperator(matrix.shape, matvec=precondition, dtype=np.float64)
        solved = [
            scipy.sparse.linalg.cg(matrix, column, rtol=_CG_TOLERANCE, maxiter=_CG_ITERATIONS, M=M)[0]
            for column in right.reshape(len(right), -1).T
        ]
        return np.stack(solved, axis=1).reshape(right.shape)


def factorised(matrix: Matrix) -> scipy.sparse.linalg.SuperLU:
    """Factors of a symmetric matrix in the order that it is in, its diagonal being the pivots.

    So the signs of the U factor's diagonal are those of the eigenvalues (Sylvester's law of inertia).
    """
    try:
        return scipy.sparse.linalg.splu(
            scipy.sparse.csc_array(matrix),
            permc_spec="NATURAL",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError as error:  # a pivot is exactly zero
        raise np.linalg.LinAlgError(str(error)) from error


def _elimination_order(a: Index, b: Index, count: int) -> tuple[Index, float]:
    """Minimum-degree order of the nodes, and the multiplications of a scalar factorisation in it."""
    inside = (a >= 0) & (b >= 0) & (a != b)
    a, b = a[inside], b[inside]
    links = scipy.sparse.coo_array(
        (np.full(2 * len(a), -1.0), (np.r_[a, b], np.r_[b, a])), shape=(count, count)
    ).tocsc()
    degree = -np.asarray(links.sum(axis=0)).ravel()
    factors = scipy.sparse.linalg.splu(
        (links + scipy.sparse.diags_array(degree + 1.0)).tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    column_counts = np.diff(factors.L.indptr).astype(np.float64)
    return np.argsort(factors.perm_c), float((column_counts**2).sum())
