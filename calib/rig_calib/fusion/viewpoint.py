"""Where a rig is looked from: its axis, its centre, and which way its images stand."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_protocol.poses import Pose

Array = npt.NDArray[np.float64]

# Optical axes whose mean is longer than this look to one side; spread over half a circle they have 0.64.
_ONE_SIDED = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """The frame that people look from: origin amid the cameras, z up, x to the front.

    `portrait`: the cameras lie on their side, image x pointing down, as in the ring.
    """

    T_rig_view: Pose
    portrait: bool


def rig_viewpoint(poses: Mapping[int, Pose], rig_frame: str = "camera 0") -> Viewpoint:
    """The viewpoint of cameras at poses T_rig_camera; ValueError without any.

    Up is the rig's z when the frame is the ring's. Otherwise it is the mean of the images' own: of −x
    (portrait) where the cameras look around and agree on that better than on −y, for around a ring only
    its axis is common to all; of −y (landscape) where they look to one side and nothing tells.
    The front is that side, or the first camera's.
    """
    if not poses:
        raise ValueError("a viewpoint needs at least one camera with a pose")
    rotations = np.array([poses[camera_id][:3, :3] for camera_id in sorted(poses)])
    optical_axes = rotations[:, :, 2]
    image_ups = -rotations[:, :, :2].mean(axis=0).T  # rows: portrait, landscape
    one_sided = np.linalg.norm(optical_axes.mean(axis=0)) > _ONE_SIDED
    if rig_frame == "ring":
        up = np.array([0.0, 0.0, 1.0])
        portrait = bool(image_ups[0] @ up >= image_ups[1] @ up)
    else:
        portrait = not one_sided and bool(np.linalg.norm(image_ups[0]) >= np.linalg.norm(image_ups[1]))
        up = image_ups[0] if portrait else image_ups[1]
        up = up / np.linalg.norm(up)
    T = np.eye(4)
    T[:3, :3] = _axes(up, optical_axes)
    T[:3, 3] = np.mean([T_rig_camera[:3, 3] for T_rig_camera in poses.values()], axis=0)
    return Viewpoint(T, portrait)


def _axes(up: Array, optical_axes: Array) -> Array:
    """Columns x, y, z of the view in the rig frame: z is `up`, x the horizontal part of the front."""
    mean = optical_axes.mean(axis=0)
    front = mean if np.linalg.norm(mean) > _ONE_SIDED else optical_axes[0]
    x = front - up * (front @ up)
    if np.linalg.norm(x) < 1e-6:  # it looks straight up or down: any front will do
        x = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(up, x), up])
