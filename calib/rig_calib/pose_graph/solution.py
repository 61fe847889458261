"""A pose graph solved as a whole: start, optimum, certificate; wrong edges rejected if asked."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rig_calib.pose_graph.block_matrix import BlockPattern
from rig_calib.pose_graph.edge_batch import EdgeBatch, Objective
from rig_calib.pose_graph.g2o import PoseGraph
from rig_calib.pose_graph.optimality import Certificate, certify
from rig_calib.pose_graph.optimiser import minimise
from rig_calib.pose_graph.robust import reject_wrong_edges
from rig_calib.pose_graph.start import chordal_start
from rig_calib.stages import Progress

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

_LOWER = 1e-6  # relative: this much lower is another optimum, not another last digit

OBJECTIVES: dict[Objective, str] = {
    "chordal": "sum kappa |R_j - R_i R_ij|^2 + tau |t_j - t_i - R_i t_ij|^2 (SE-Sync's)",
    "geodesic": "1/2 sum r' Lambda r, r = Log(T_ij^-1 T_i^-1 T_j), full 6x6 information",
}


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The graph with its optimal poses; which edges (M,) were kept, and both objectives of those.

    `before` holds the objectives of all edges at the given poses. `certificate` is the chordal optimum's,
    from which a geodesic one starts.
    """

    graph: PoseGraph
    kept: Mask
    objective: Objective
    before: dict[Objective, float]
    after: dict[Objective, float]
    certificate: Certificate
    seconds: float

    @property
    def rejected(self) -> list[tuple[int, int]]:
        """Ids of the two poses of every rejected edge, in the order of the edges."""
        ids, edges = self.graph.ids, self.graph.edges
        return [(ids[edges.i[k]], ids[edges.j[k]]) for k in np.flatnonzero(~self.kept)]

    def to_dict(self) -> dict[str, Any]:
        """For JSON; `rejected` names edges by the ids of their poses and by number, from 0."""
        certificate = self.certificate
        return {
            "poses": len(self.graph.ids),
            "edges": len(self.kept),
            "objective": self.objective,
            "objective_definition": OBJECTIVES[self.objective],
            "before": self.before,
            "after": self.after,
            "certificate": {
                "of": OBJECTIVES["chordal"],
                "certified": certificate.certified,
                "value": certificate.objective,
                "lower_bound": certificate.lower_bound,
                "gap": certificate.gap,
                "smallest_eigenvalue": certificate.eigenvalue,
            },
            "rejected": [
                {"i": i, "j": j, "edge": int(k)}
                for (i, j), k in zip(self.rejected, np.flatnonzero(~self.kept), strict=True)
            ],
            "seconds": self.seconds,
        }


def solve(
    graph: PoseGraph,
    robust: bool = False,
    objective: Objective | None = None,
    tell: Progress = lambda _stage, _share: None,
) -> Solution:
    """The optimum of a pose graph, from its edges alone: its poses only define the frame, or a second try.

    Without an objective: the chordal one, whose optimum can be certified, if the information of every edge
    is nearly isotropic, else the geodesic one. Parts without a fixed pose keep their first pose.
    `tell` is told the stage and the share that is done.
    """
    started_s = time.perf_counter()
    count, edges = len(graph.ids), graph.edges
    if objective is None:
        objective = "chordal" if edges.nearly_isotropic() else "geodesic"
    free = ~_fixed_in_every_part(graph.fixed, edges.parts(count))
    pattern = BlockPattern(edges.i, edges.j, free)
    kept = np.ones(len(edges), dtype=bool)
    tell("start", 0.0)
    if robust:
        weighed = edges.isotropic() if objective == "chordal" else edges
        start, kept = reject_wrong_edges(graph.T, weighed, pattern, objective, tell)
        pattern = BlockPattern(edges.i[kept], edges.j[kept], free)
    else:
        start = chordal_start(graph.T, edges, pattern)
    used = edges.select(kept)
    T, certificate = _chordal_optimum(graph.T, start, used.isotropic(), pattern, tell)
    if objective == "geodesic":
        tell("full information", 0.95)
        T, _, _ = minimise(T, used, pattern, "geodesic")
    return Solution(
        graph.with_poses(T),
        kept,
        objective,
        objectives(graph.T, graph.edges),
        objectives(T, used),
        certificate,
        time.perf_counter() - started_s,
    )


def objectives(T: Array, edges: EdgeBatch) -> dict[Objective, float]:
    """Both objectives of poses T (N,4,4), each as its definition in `OBJECTIVES` says."""
    return {
        "chordal": float(edges.isotropic().squared_distances(T, "chordal").sum()),
        "geodesic": 0.5 * float(edges.squared_distances(T, "geodesic").sum()),
    }


def _chordal_optimum(
    given: Array, start: Array, edges: EdgeBatch, pattern: BlockPattern, tell: Progress
) -> tuple[Array, Certificate]:
    """The chordal optimum from a start; where that is not certified, also from the given poses.

    Unless the graph is too large for a certificate and the given poses are no better to begin with.
    """
    tell("optimum", 0.0)
    T, cost, _ = minimise(start, edges, pattern, "chordal")
    tell("certificate", 0.8)
    certificate = certify(T, edges)
    given_cost = 0.5 * float(edges.squared_distances(given, "chordal").sum())
    if certificate.certified or (certificate.gap is None and given_cost >= cost):
        return T, certificate
    tell("second start", 0.9)
    other, other_cost, _ = minimise(given, edges, pattern, "chordal")
    if other_cost < cost * (1.0 - _LOWER):
        return other, certify(other, edges)
    return T, certificate


def _fixed_in_every_part(fixed: Mask, parts: Index) -> Mask:
    """The fixed nodes, and the first one of every part that has none."""
    holds = np.isin(parts, parts[fixed])
    _, first = np.unique(parts, return_index=True)
    out = fixed.copy()
    out[first[~holds[first]]] = True
    return out
