"""One rig against another: the rigid motion that brings two sets of camera poses together."""

from collections.abc import Mapping

import numpy as np

from rig_protocol.poses import Pose


def align_frames(poses: Mapping[int, Pose], targets: Mapping[int, Pose]) -> Pose:
    """T_target_pose over the cameras that both hold: T @ poses[c] is nearest to targets[c].

    The rotation is the mean of the cameras' (chordal); the translation then the mean of what is left. A ring
    is small, so that its cameras' rotations say more of its attitude than their positions.
    """
    common = sorted(poses.keys() & targets.keys())
    if not common:
        return np.eye(4)
    U, _, Vt = np.linalg.svd(np.sum([targets[c][:3, :3] @ poses[c][:3, :3].T for c in common], axis=0))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    T[:3, 3] = np.mean([targets[c][:3, 3] - T[:3, :3] @ poses[c][:3, 3] for c in common], axis=0)
    return T
