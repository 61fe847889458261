"""The pose graph beside GTSAM on the same graphs in the same run: seconds and both objectives of each.

GTSAM minimises the geodesic error, from its own chordal initialisation; we minimise the chordal objective
and, in a second entry, the geodesic error. Seconds are for a graph in memory; ours include the certificate.
"""

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).parents[1]))

from rig_calib.pose_graph.edge_batch import Objective
from rig_calib.pose_graph.g2o import PoseGraph, read_g2o
from rig_calib.pose_graph.solution import objectives, solve
from support.benchmark_record import REPOSITORY
from support.pose_graphs import spiral

Array = npt.NDArray[np.float64]

_ROUNDS = 3  # of which the quickest counts: other work on the machine only slows
_OPTIMUM_OF_SPHERE = 1.687e3  # SE-Sync's, certified


def run() -> dict[str, Any]:
    """Figures for build/bench.json: `peers`, one a graph and solver, and how far above the optimum."""
    peers = [entry for name, graph in _graphs() for entry in _compared(name, graph)]
    sphere = [peer for peer in peers if peer["graph"] == "sphere2500"]
    above = {peer["name"]: peer["chordal"] / _OPTIMUM_OF_SPHERE - 1.0 for peer in sphere}
    return {"peers": peers, "sphere2500_above_optimum": above}


def _graphs() -> Iterator[tuple[str, PoseGraph]]:
    data = Path(os.environ.get("RIG_REAL_DATA", REPOSITORY.parent / "shared" / "data"))
    sphere = data / "pose_graphs" / "sphere2500.g2o"
    if sphere.exists():
        yield "sphere2500", read_g2o(sphere)
    else:
        print(f"{sphere} is absent: point RIG_REAL_DATA at a folder that holds pose_graphs/")
    yield "spiral of 5,000", spiral(5000, per_turn=50)[0]


def _compared(name: str, graph: PoseGraph) -> Iterator[dict[str, Any]]:
    def ours(objective: Objective) -> Callable[[], Array]:
        return lambda: solve(graph, objective=objective).graph.T

    solvers = {"ours, chordal": ours("chordal"), "ours, geodesic": ours("geodesic"), "gtsam": _gtsam(graph)}
    for solver, optimised in solvers.items():
        seconds, T = min((_timed(optimised) for _ in range(_ROUNDS)), key=lambda timed: timed[0])
        values = objectives(T, graph.edges)
        yield {
            "name": solver,
            "graph": name,
            "poses": len(graph.ids),
            "edges": len(graph.edges),
            "seconds": round(seconds, 3),
            **{objective: round(value, 3) for objective, value in values.items()},
        }


def _timed(optimised: Callable[[], Array]) -> tuple[float, Array]:
    started_s = time.perf_counter()
    T = optimised()
    return time.perf_counter() - started_s, T


def _gtsam(graph: PoseGraph) -> Callable[[], Array]:
    """GTSAM with its defaults on the same graph, whose first pose a sharp prior holds."""
    import gtsam

    factors = gtsam.NonlinearFactorGraph()
    edges = graph.edges
    for i, j, T_i_j, information in zip(edges.i, edges.j, edges.T_i_j, edges.information, strict=True):
        noise = gtsam.noiseModel.Gaussian.Information(information)
        factors.add(gtsam.BetweenFactorPose3(int(i), int(j), gtsam.Pose3(T_i_j), noise))
    sharp = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
    factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(graph.T[0]), sharp))

    def optimised() -> Array:
        start = gtsam.InitializePose3.initialize(factors)
        result = gtsam.LevenbergMarquardtOptimizer(factors, start).optimize()
        return np.array([result.atPose3(k).matrix() for k in range(len(graph.ids))])

    return optimised


if __name__ == "__main__":
    print(json.dumps(run(), indent=1))
