"""Pose graph over SE(3): the poses that agree best with measured relative poses (eq. 6 of the paper).

Any graph will do: a ring with its loop closure, all pairs of a rig, a map of thousands of poses.
"""

from rig_calib.pose_graph.edge_batch import squared_distances
from rig_calib.pose_graph.graph import (
    PoseEdge,
    chain_poses,
    connected_groups,
    edge_residual,
    loop_error,
    spanning_tree,
)
from rig_calib.pose_graph.optimiser import PoseGraphResult, optimise

__all__ = [
    "PoseEdge",
    "PoseGraphResult",
    "chain_poses",
    "connected_groups",
    "edge_residual",
    "loop_error",
    "optimise",
    "spanning_tree",
    "squared_distances",
]
