"""A mesh against the simulator's rectangles: how far it lies from them, and how much of them it has.

What counts is what a depth camera can see: a point of a rectangle that lies in its image, 0.5 to 5 m away,
at less than 80° from the normal, with nothing in between. Written from the simulator's truth.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from rig_agent.simulator.ring import VirtualRig
from rig_agent.simulator.surface import Surface
from rig_calib.tsdf.mesh import Mesh
from rig_protocol.poses import Pose, inverse, transform_points
from support.true_optics import Array, Index, first_hits, pixels_of_points

SPACING_M = 0.02
"""Between points of the true surfaces."""

MESH_POINTS = 200_000
_RANGE_M = (0.5, 5.0)
_STEEPEST = np.cos(np.deg2rad(80.0))
_SAME_M = 1e-3  # a ray that ends so near a point ends there
_CANDIDATES = 4  # rectangles of so many nearest points are tried


@dataclass(frozen=True, slots=True, eq=False)
class SeenSurfaces:
    """Points (N,3) of the room that a camera sees, and the rectangle (N,) that each lies on."""

    surfaces: Sequence[Surface]
    points: Array
    owner: Index

    def distances_m(self, points: Array) -> Array:
        """Exact distances (M,) of points (M,3) of the room from the rectangles seen nearest to them."""
        _, nearest = KDTree(self.points).query(points, _CANDIDATES)
        owners = self.owner[nearest]
        result = np.full(len(points), np.inf)
        for k in np.unique(owners):
            near = np.flatnonzero((owners == k).any(axis=1))
            result[near] = np.minimum(result[near], _distance_m(self.surfaces[k], points[near]))
        return result


def seen_surfaces(rig: VirtualRig) -> SeenSurfaces:
    """What the depth cameras of a simulated rig can see of its room."""
    surfaces = rig.scene.surfaces
    lattices = [_lattice(surface) for surface in surfaces]
    points = np.concatenate(lattices)
    owner = np.repeat(np.arange(len(surfaces)), [len(lattice) for lattice in lattices])
    normals = np.array([surface.normal for surface in surfaces])[owner]
    seen = np.zeros(len(points), np.bool_)
    for camera in range(rig.settings.cameras):
        seen |= _seen_by(rig, camera, points, normals)
    return SeenSurfaces(surfaces, points[seen], owner[seen])


def accuracy_mm(mesh: Mesh, T_room_rig: Pose, truth: SeenSurfaces) -> dict[str, float]:
    """Distances of the mesh, sampled evenly by area, from the true surfaces: median, 90 %, RMS; outliers."""
    points = transform_points(T_room_rig, _points_on(mesh, MESH_POINTS))
    error_mm = 1e3 * truth.distances_m(points)
    return {
        "median_mm": float(np.median(error_mm)),
        "p90_mm": float(np.percentile(error_mm, 90)),
        "rms_mm": float(np.sqrt(np.mean(error_mm**2))),
        "beyond_50_mm": float(np.mean(error_mm > 50)),
    }


def completeness(mesh: Mesh, T_room_rig: Pose, truth: SeenSurfaces) -> dict[str, float]:
    """Share of the true surface seen that has mesh (its vertices and faces' centres) within 2 and 5 cm."""
    centres = mesh.vertices_m[mesh.faces].mean(axis=1)
    held = transform_points(T_room_rig, np.concatenate([mesh.vertices_m, centres]))
    away, _ = KDTree(held).query(truth.points, distance_upper_bound=0.06)
    return {"within_20_mm": float(np.mean(away < 0.02)), "within_50_mm": float(np.mean(away < 0.05))}


def _lattice(surface: Surface) -> Array:
    edges = (surface.edge_u, surface.edge_v)
    counts = [max(1, round(float(np.linalg.norm(edge)) / SPACING_M)) for edge in edges]
    s, t = np.meshgrid(*((np.arange(count) + 0.5) / count for count in counts))
    return np.asarray(surface.corner + s.reshape(-1, 1) * edges[0] + t.reshape(-1, 1) * edges[1])


def _seen_by(rig: VirtualRig, camera: int, points: Array, normals: Array) -> npt.NDArray[np.bool_]:
    view = rig.camera(camera).view()
    lens = view.unit.depth
    local = transform_points(inverse(view.T_room_depth), points)
    to_eye = view.T_room_depth[:3, 3] - points
    cosine = (to_eye * normals).sum(axis=1) / np.linalg.norm(to_eye, axis=1)
    seen = (local[:, 2] > _RANGE_M[0]) & (local[:, 2] < _RANGE_M[1]) & (cosine > _STEEPEST)
    pixels = pixels_of_points(lens, local[seen])
    seen[seen] = ((pixels > 0) & (pixels < (lens.width - 1, lens.height - 1))).all(axis=1)
    ends = first_hits(rig.scene.surfaces, view.T_room_depth, local[seen, :2] / local[seen, 2:]).points
    seen[seen] = np.linalg.norm(ends - local[seen], axis=1) < _SAME_M
    return seen


def _points_on(mesh: Mesh, count: int) -> Array:
    """Points (count,3) of the mesh, evenly by area."""
    rng = np.random.default_rng(0)
    area = np.linalg.norm(mesh.face_normals(), axis=1)
    faces = mesh.faces[rng.choice(len(area), count, p=area / area.sum())]
    s, t = rng.random((2, count, 1))
    beyond = s + t > 1
    s, t = np.where(beyond, 1 - s, s), np.where(beyond, 1 - t, t)
    a, b, c = (mesh.vertices_m[faces[:, k]] for k in range(3))
    return np.asarray(a + s * (b - a) + t * (c - a))


def _distance_m(surface: Surface, points: Array) -> Array:
    u, v = surface.edge_u, surface.edge_v  # at right angles
    offset = points - surface.corner
    s, t = np.clip(offset @ u / (u @ u), 0, 1), np.clip(offset @ v / (v @ v), 0, 1)
    return np.asarray(np.linalg.norm(offset - s[:, None] * u - t[:, None] * v, axis=1))
