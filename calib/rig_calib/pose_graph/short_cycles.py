"""Which edges close a short cycle with others: false ones hardly ever do.

Cycles of two (repeated), three and four edges: two paths of one or two edges between the same nodes.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.pose_graph.edge_batch import EdgeBatch
from rig_calib.pose_graph.se3_batches import adjoints, inverses, logarithms

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

_AGREEMENT = 22.5  # 99.9 % of a six-dimensional residual
_MAX_DEGREE = 40  # paths through busier nodes are too many, and not needed
_MAX_PATHS_COMPARED = 30  # with each path, of all that join the same two nodes


@dataclass(frozen=True, slots=True, eq=False)
class _Paths:
    """P paths from `start` to `end`: T_start_end, its covariance (right), edges used (P,2), −1 for none."""

    start: Index
    end: Index
    T: Array
    covariance: Array
    edges: Index

    def select(self, rows: Index | Mask) -> "_Paths":
        return _Paths(self.start[rows], self.end[rows], self.T[rows], self.covariance[rows], self.edges[rows])


def on_agreeing_cycle(edges: EdgeBatch) -> Mask:
    """True for every edge (M,) of a short cycle that closes within its edges' covariance."""
    arcs = _arcs(edges)
    paths = _joined(arcs.select(arcs.start < arcs.end), _two_step_paths(arcs))
    key = paths.start * (int(paths.end.max(initial=0)) + 1) + paths.end
    by_key = np.argsort(key, kind="stable")
    paths, key = paths.select(by_key), key[by_key]
    agreeing = np.zeros(len(edges) + 1, dtype=bool)  # the last one stands for "none", −1
    for distance in range(1, min(_MAX_PATHS_COMPARED, len(key))):
        first = np.flatnonzero(key[distance:] == key[:-distance])
        if not len(first):
            break
        agreeing[_edges_of_closed(paths, first, first + distance)] = True
    return agreeing[:-1]


def _arcs(edges: EdgeBatch) -> _Paths:
    """Every edge in both directions: Exp(δ) on the right of T is Exp(−Ad δ) on the right of T⁻¹."""
    covariance = np.asarray(np.linalg.inv(edges.information), dtype=np.float64)
    Ad = adjoints(edges.T_i_j)
    number = np.arange(len(edges))
    alone = np.stack([number, np.full(len(edges), -1)], axis=1)
    return _joined(
        _Paths(edges.i, edges.j, edges.T_i_j, covariance, alone),
        _Paths(edges.j, edges.i, inverses(edges.T_i_j), Ad @ covariance @ Ad.transpose(0, 2, 1), alone),
    )


def _joined(a: _Paths, b: _Paths) -> _Paths:
    return _Paths(
        np.concatenate([a.start, b.start]),
        np.concatenate([a.end, b.end]),
        np.concatenate([a.T, b.T]),
        np.concatenate([a.covariance, b.covariance]),
        np.concatenate([a.edges, b.edges]),
    )


def _two_step_paths(arcs: _Paths) -> _Paths:
    """Two different arcs in a row, from the lower to the higher node."""
    arcs = arcs.select(np.argsort(arcs.start, kind="stable"))
    first_leaving, after = (np.searchsorted(arcs.start, arcs.end, side=side) for side in ("left", "right"))
    leaving = np.where(after - first_leaving <= _MAX_DEGREE, after - first_leaving, 0)
    x = np.repeat(np.arange(len(leaving)), leaving)
    y = np.arange(len(x)) - np.repeat(np.cumsum(leaving) - leaving - first_leaving, leaving)
    upward = arcs.start[x] < arcs.end[y]
    x, y = x[upward], y[upward]
    Ad = adjoints(inverses(arcs.T[y]))
    covariance = Ad @ arcs.covariance[x] @ Ad.transpose(0, 2, 1) + arcs.covariance[y]
    used = np.stack([arcs.edges[x, 0], arcs.edges[y, 0]], axis=1)
    return _Paths(arcs.start[x], arcs.end[y], arcs.T[x] @ arcs.T[y], covariance, used)


def _edges_of_closed(paths: _Paths, p: Index, q: Index) -> Index:
    """Edges of the pairs of paths that share no edge and end at the same pose within their covariance."""
    shared = (paths.edges[p][:, :, None] == paths.edges[q][:, None, :]) & (paths.edges[p] >= 0)[:, :, None]
    apart = ~shared.any(axis=(1, 2))
    p, q = p[apart], q[apart]
    gap = inverses(paths.T[p]) @ paths.T[q]
    r, Ad = logarithms(gap), adjoints(inverses(gap))
    covariance = Ad @ paths.covariance[p] @ Ad.transpose(0, 2, 1) + paths.covariance[q]
    distance = (r * np.linalg.solve(covariance, r[..., None])[..., 0]).sum(axis=1)
    closed = distance <= _AGREEMENT
    return np.asarray(np.concatenate([paths.edges[p[closed]].ravel(), paths.edges[q[closed]].ravel()]))
