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
from rig_protocol.poses import Pose, inverse, transform_points

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
    for candidate in _candidates(surfaces, T_room_camera, rays):
        part = rays.crop(candidate.window)
        inverse_z, s, t = (_evaluate(form, part) for form in candidate.forms)
        best = hits.inverse_z[candidate.window]
        inside = (inverse_z > best) & (s >= 0) & (s <= inverse_z) & (t >= 0) & (t <= inverse_z)
        np.copyto(best, inverse_z, where=inside)
        np.copyto(hits.surface[candidate.window], np.int16(candidate.index), where=inside)
    return hits


def shade(scene: Scene, hits: Hits, T_room_camera: Pose, rays: RayGrid) -> ImageU8:
    """Colour (rows, columns, 3) BGR of what the rays hit, under the scene's lamp."""
    image = np.zeros((*rays.shape, 3), np.uint8)
    counts = np.bincount(hits.surface[hits.surface != NOTHING], minlength=len(scene.surfaces))
    for candidate in _candidates(scene.surfaces, T_room_camera, rays):
        if counts[candidate.index]:
            _paint(image[candidate.window], candidate, scene, hits, rays)
    return image


def _paint(image: ImageU8, candidate: "_Candidate", scene: Scene, hits: Hits, rays: RayGrid) -> None:
    """Put one surface's texture where the rays of its window hit it."""
    surface = scene.surfaces[candidate.index]
    part, mask = rays.crop(candidate.window), hits.surface[candidate.window] == candidate.index
    z = 1 / np.where(mask, hits.inverse_z[candidate.window], 1)
    footprint_m = float(np.median(z[mask])) * rays.spacing / _slant(candidate.forms)
    texture = _filtered(surface.texture(scene.seed, candidate.index, scene.light), surface, footprint_m)
    rows, columns = texture.shape[:2]
    sampled = cv2.remap(
        texture,
        _evaluate(candidate.forms[1], part) * z * columns - 0.5,
        _evaluate(candidate.forms[2], part) * z * rows - 0.5,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    cv2.copyTo(sampled, mask.astype(np.uint8), image)


def cosine_of_incidence(surfaces: Sequence[Surface], hits: Hits, T_room_camera: Pose, rays: RayGrid) -> Plane:
    """Cosine (rows, columns) between ray and normal; 0 where nothing is hit."""
    normals = surface_normals(surfaces) @ T_room_camera[:3, :3]
    nx, ny, nz = (normals[:, axis].astype(np.float32)[hits.surface] for axis in range(3))
    length = np.sqrt(rays.x**2 + rays.y**2 + 1)
    return np.asarray(np.abs(nx * rays.x + ny * rays.y + nz) / length, dtype=np.float32)


def surface_normals(surfaces: Sequence[Surface]) -> Matrix:
    """Normals (N+1,3) in the room; the last, which NOTHING indexes, is zero."""
    return np.array([surface.normal for surface in surfaces] + [np.zeros(3)])


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A surface that a camera may see: its linear forms 1/z, s/z, t/z (rows) and the window it can cover."""

    index: int
    forms: Matrix
    window: tuple[slice, slice]


def _candidates(surfaces: Sequence[Surface], T_room_camera: Pose, rays: RayGrid) -> list[_Candidate]:
    """Surfaces that face the camera and reach into its view."""
    T_camera_room = inverse(T_room_camera)
    corners = transform_points(T_camera_room, np.array([surface.corners for surface in surfaces]))
    forms, facing = _linear_forms(corners)
    found = []
    for index in np.flatnonzero(facing & (corners[..., 2].max(axis=1) > _NEAR_M)).tolist():
        polygon = _in_front(corners[index])
        flat = polygon[:, :2] / polygon[:, 2:]
        window = rays.window(flat.min(axis=0), flat.max(axis=0))
        if window is not None:
            found.append(_Candidate(index, forms[index], window))
    return found


def _linear_forms(corners: Matrix) -> tuple[Matrix, npt.NDArray[np.bool_]]:
    """Forms (N,3,3) of rectangles (N,4,3), rows 1/z, s/z, t/z, and which of them show their front (N,)."""
    origin, edge_u, edge_v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    normal = np.cross(edge_u, edge_v)
    distance = (normal * origin).sum(axis=1)
    facing = distance < 0
    inverse_z = normal / np.where(facing, distance, 1)[:, None]
    forms = [inverse_z]
    for edge, dual in ((edge_u, np.cross(edge_v, normal)), (edge_v, np.cross(normal, edge_u))):
        dual = dual / (dual * edge).sum(axis=1, keepdims=True)
        forms.append(dual - (dual * origin).sum(axis=1, keepdims=True) * inverse_z)
    return np.stack(forms, axis=1), facing


def _evaluate(form: Matrix, rays: tuple[Plane, Plane]) -> Plane:
    a, b, c = (np.float32(value) for value in form)
    return np.asarray(a * rays[0] + (b * rays[1] + c), dtype=np.float32)


def _in_front(corners: Matrix) -> Matrix:
    """The polygon (N,3) cut off at the near plane."""
    if (corners[:, 2] >= _NEAR_M).all():
        return corners
    kept = []
    for here, after in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if here[2] >= _NEAR_M:
            kept.append(here)
        if (here[2] >= _NEAR_M) != (after[2] >= _NEAR_M):
            share = (_NEAR_M - here[2]) / (after[2] - here[2])
            kept.append(here + share * (after - here))
    return np.array(kept)


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
