"""Ray casting of textured rectangles with NumPy.

For a ray r = (x, y, 1) and a plane through o with edges a, b and normal n, all in the camera frame, the
point is z·r with 1/z = n·r / n·o, and s/z and t/z are linear in r too: a hit needs three linear forms
and no division.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_agent.simulator.lens import Plane, RayGrid
from rig_agent.simulator.scene import Scene
from rig_agent.simulator.surface import Surface
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose, inverse

Matrix = npt.NDArray[np.float64]

_NEAR_M = 0.05
NOTHING = -1


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """What each ray meets first: 1/z (1/m, 0 = nothing) and the index of the surface (−1 = nothing)."""

    inverse_z: Plane
    surface: npt.NDArray[np.int16]


def cast(surfaces: Sequence[Surface], T_room_camera: Pose, rays: RayGrid) -> Hits:
    """First hits of all rays of a camera."""
    hits = Hits(np.zeros(rays.shape, np.float32), np.full(rays.shape, NOTHING, np.int16))
    T_camera_room = inverse(T_room_camera)
    for index, surface in enumerate(surfaces):
        forms = _linear_forms(surface, T_camera_room)
        if forms is None or (window := _window(surface, T_camera_room, rays)) is None:
            continue
        part = rays.crop(window)
        inverse_z, s, t = (_evaluate(form, part) for form in forms)
        best = hits.inverse_z[window]
        inside = (inverse_z > best) & (s >= 0) & (s <= inverse_z) & (t >= 0) & (t <= inverse_z)
        np.copyto(best, inverse_z, where=inside)
        np.copyto(hits.surface[window], np.int16(index), where=inside)
    return hits


def shade(scene: Scene, hits: Hits, T_room_camera: Pose, rays: RayGrid) -> ImageU8:
    """Colour (rows, columns, 3) BGR of what the rays hit, under the scene's lamp."""
    image = np.zeros((*rays.shape, 3), np.uint8)
    T_camera_room = inverse(T_room_camera)
    counts = np.bincount(hits.surface[hits.surface != NOTHING], minlength=len(scene.surfaces))
    for index in np.flatnonzero(counts).tolist():
        surface = scene.surfaces[index]
        forms = _linear_forms(surface, T_camera_room)
        window = _window(surface, T_camera_room, rays)
        if forms is None or window is None:
            continue
        part, mask = rays.crop(window), hits.surface[window] == index
        z = 1 / np.where(mask, hits.inverse_z[window], 1)
        texture = surface.texture(scene.seed, index, scene.light)
        texture = _filtered(texture, surface, float(np.median(z[mask])) * _sample_angle(rays) / _slant(forms))
        rows, columns = texture.shape[:2]
        sampled = cv2.remap(
            texture,
            _evaluate(forms[1], part) * z * columns - 0.5,
            _evaluate(forms[2], part) * z * rows - 0.5,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        cv2.copyTo(sampled, mask.astype(np.uint8), image[window])
    return image


def cosine_of_incidence(surfaces: Sequence[Surface], hits: Hits, T_room_camera: Pose, rays: RayGrid) -> Plane:
    """Cosine (rows, columns) between ray and normal; 0 where nothing is hit."""
    normals = np.array([surface.normal for surface in surfaces] + [np.zeros(3)]) @ T_room_camera[:3, :3]
    nx, ny, nz = (normals[:, axis].astype(np.float32)[hits.surface] for axis in range(3))
    length = np.sqrt(rays.x**2 + rays.y**2 + 1)
    return np.asarray(np.abs(nx * rays.x + ny * rays.y + nz) / length, dtype=np.float32)


def _linear_forms(surface: Surface, T_camera_room: Pose) -> Matrix | None:
    """Rows (A, B, C) of 1/z, s/z, t/z as functions of the ray; None when the camera sees the back."""
    R = T_camera_room[:3, :3]
    corner = R @ surface.corner + T_camera_room[:3, 3]
    edge_u, edge_v = R @ surface.edge_u, R @ surface.edge_v
    normal = np.cross(edge_u, edge_v)
    distance = normal @ corner
    if distance >= 0:
        return None
    inverse_z = normal / distance
    dual_u, dual_v = np.cross(edge_v, normal), np.cross(normal, edge_u)
    dual_u, dual_v = dual_u / (dual_u @ edge_u), dual_v / (dual_v @ edge_v)
    return np.array(
        [inverse_z, dual_u - (dual_u @ corner) * inverse_z, dual_v - (dual_v @ corner) * inverse_z]
    )


def _evaluate(form: Matrix, rays: RayGrid) -> Plane:
    a, b, c = (np.float32(value) for value in form)
    return np.asarray(a * rays.x + (b * rays.y + c), dtype=np.float32)


def _window(surface: Surface, T_camera_room: Pose, rays: RayGrid) -> tuple[slice, slice] | None:
    """The part of the image that the surface can cover; None when it is out of sight."""
    corners = surface.corners @ T_camera_room[:3, :3].T + T_camera_room[:3, 3]
    polygon = _in_front(corners)
    if not len(polygon):
        return None
    flat = polygon[:, :2] / polygon[:, 2:]
    rows, columns = rays.window(flat.min(axis=0), flat.max(axis=0))
    return None if rows.start == rows.stop or columns.start == columns.stop else (rows, columns)


def _in_front(corners: Matrix) -> Matrix:
    """The polygon (N,3) cut off at the near plane."""
    kept = []
    for here, after in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if here[2] >= _NEAR_M:
            kept.append(here)
        if (here[2] >= _NEAR_M) != (after[2] >= _NEAR_M):
            share = (_NEAR_M - here[2]) / (after[2] - here[2])
            kept.append(here + share * (after - here))
    return np.array(kept)


def _sample_angle(rays: RayGrid) -> float:
    """Angle between neighbouring samples near the axis, rad."""
    middle = rays.shape[0] // 2
    return float(rays.y[middle + 1, 0] - rays.y[middle, 0])


def _slant(forms: Matrix) -> float:
    """Square root of the cosine between normal and optical axis: the mean of a footprint's two sides."""
    cosine = abs(forms[0, 2]) / float(np.linalg.norm(forms[0]))
    return float(np.sqrt(max(cosine, 0.05)))


def _filtered(texture: ImageU8, surface: Surface, footprint_m: float) -> ImageU8:
    """The texture without detail finer than the samples, which would alias differently in every camera."""
    scale = surface.texel_m / footprint_m
    if scale > 0.8:
        return texture
    rows, columns = (max(1, round(size * scale)) for size in texture.shape[:2])
    return np.asarray(cv2.resize(texture, (columns, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8)
