"""What every ray of the simulated ring really meets, and where every point really appears.

Written from the simulator's truth for the study of the calibration's bound; shares no formula with the
estimator that is judged.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_agent.simulator.surface import Surface
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import Pose, inverse, transform_points

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

_STEPS = 20


@dataclass(frozen=True, slots=True, eq=False)
class FirstHits:
    """Where N rays end: points (N,3) in the camera's frame, surface (N,) (−1: nowhere), 1/z planes (N,3).

    On the surface 1/z = plane · (x, y, 1) for the ray (x, y, 1).
    """

    points: Array
    surface: Index
    planes: Array


def first_hits(surfaces: Sequence[Surface], T_room_camera: Pose, rays: Array) -> FirstHits:
    """Cast rays (N,2), tangents of the camera, at rectangles that show their front."""
    directions = np.column_stack([rays, np.ones(len(rays))])
    nearest = np.zeros(len(rays))  # 1/z
    index, planes = np.full(len(rays), -1), np.zeros((len(rays), 3))
    T_camera_room = inverse(T_room_camera)
    for k, surface in enumerate(surfaces):
        corner = transform_points(T_camera_room, surface.corner)
        u, v = (T_camera_room[:3, :3] @ edge for edge in (surface.edge_u, surface.edge_v))
        normal = np.cross(u, v)
        if normal @ corner >= 0:
            continue
        plane = normal / (normal @ corner)
        inverse_z = directions @ plane
        with np.errstate(divide="ignore", invalid="ignore"):
            offset = directions / inverse_z[:, None] - corner
        s, t = offset @ u / (u @ u), offset @ v / (v @ v)  # the edges are at right angles
        inside = (inverse_z > nearest) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
        nearest[inside], index[inside], planes[inside] = inverse_z[inside], k, plane
    with np.errstate(divide="ignore", invalid="ignore"):
        points = directions / nearest[:, None]
    return FirstHits(points, index, planes)


def rays_of_pixels(camera: Intrinsics, pixels: Array) -> Array:
    """Tangents (N,2) of pixels (N,2) of a centred radial lens, by fixed-point iteration."""
    seen = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    k1, k2, _, _, k3 = camera.dist
    rays = seen.copy()
    for _ in range(_STEPS):
        r2 = (rays**2).sum(axis=1, keepdims=True)
        rays = seen / (1 + r2 * (k1 + r2 * (k2 + r2 * k3)))
    return rays


def pixels_of_points(camera: Intrinsics, points: Array) -> Array:
    """Pixels (N,2) of points (N,3) in the camera's frame."""
    x = points[:, :2] / points[:, 2:]
    k1, k2, _, _, k3 = camera.dist
    r2 = (x**2).sum(axis=1, keepdims=True)
    return np.asarray(
        x * (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    )
