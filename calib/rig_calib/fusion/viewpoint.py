"""Where a rig is looked from: its axis, its centre, and which way its images stand."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_protocol.poses import Pose

Array = npt.NDArray[np.float64]

# Optical axes whose mean is longer than this look to one side, and that side is the front.
_ONE_SIDED = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """The frame that people look from: origin amid the cameras, z up, x to the front.

    `portrait`: the cameras lie on their side, image x pointing down, as in the ring.
    """

    T_rig_view: Pose
    portrait: bool


def rig_viewpoint(poses: Mapping[int, Pose], rig_frame: str = "camera 0") -> Viewpoint:
    """The viewpoint of cameras at poses T_rig_camera; ValueError without any.

    Up is the rig's z when the frame is the ring's. Otherwise it is the mean direction in which images
    point up, portrait (−x) or landscape (−y), whichever the cameras agree on better: around a ring
    only its axis is common to all. The front is where the axes look on average, or the first camera's.
    """
    if not poses:
        raise ValueError("a viewpoint needs at least one camera with a pose")
    rotations = np.array([poses[camera_id][:3, :3] for camera_id in sorted(poses)])
    portrait_up, landscape_up = -rotations[:, :, 0].mean(axis=0), -rotations[:, :, 1].mean(axis=0)
    portrait = bool(np.linalg.norm(portrait_up) >= np.linalg.norm(landscape_up))
    up = portrait_up if portrait else landscape_up
    if rig_frame == "ring":
        up = np.array([0.0, 0.0, 1.0])
    T = np.eye(4)
    T[:3, :3] = _axes(up / np.linalg.norm(up), rotations[:, :, 2])
    T[:3, 3] = np.mean([T_rig_camera[:3, 3] for T_rig_camera in poses.values()], axis=0)
    return Viewpoint(T, portrait)


def _axes(up: Array, optical_axes: Array) -> Array:
    """Columns x, y, z of the view in the rig frame: z is `up`, x the horizontal part of the front."""
    mean = optical_axes.mean(axis=0)
    front = mean if np.linalg.norm(mean - up * (mean @ up)) > _ONE_SIDED else optical_axes[0]
    x = front - up * (front @ up)
    if np.linalg.norm(x) < 1e-6:  # it looks straight up or down: any front will do
        x = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(up, x), up])
