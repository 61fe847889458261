"""Textured rectangles: all that the renderer knows of a room."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_agent.simulator.streams import Stream, generator
from rig_agent.simulator.textures import PAINTERS
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose

Vector = npt.NDArray[np.float64]

_LIGHT_GRID = 12  # light varies slowly: this many samples along a surface, interpolated
_AMBIENT = 0.45  # what walls throw back
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A rectangle corner + s·edge_u + t·edge_v (s, t in 0..1), metres.

    Its front is where edge_u × edge_v points. The texture's columns run along edge_u, its rows along edge_v.
    """

    corner: Vector
    edge_u: Vector
    edge_v: Vector
    material: str
    texel_m: float = 0.004

    @property
    def normal(self) -> Vector:
        """Unit vector towards the front."""
        cross = np.cross(self.edge_u, self.edge_v)
        return np.asarray(cross / np.linalg.norm(cross))

    @property
    def corners(self) -> Vector:
        """The four corners in order, (4,3)."""
        c, u, v = self.corner, self.edge_u, self.edge_v
        return np.array([c, c + u, c + u + v, c + v])

    def texture(self, seed: int, index: int, light: Vector) -> ImageU8:
        """What the surface looks like under the lamp at `light`, (rows, columns, 3) BGR; matt."""
        columns, rows = (
            max(2, round(float(np.linalg.norm(edge)) / self.texel_m)) for edge in (self.edge_u, self.edge_v)
        )
        reflectance = PAINTERS[self.material](
            generator(seed, Stream.TEXTURE, index), (rows, columns), self.texel_m
        )
        light_map = cv2.resize(self._irradiance(light), (columns, rows), interpolation=cv2.INTER_LINEAR)
        return np.asarray(
            cv2.convertScaleAbs(reflectance * light_map[..., None], alpha=255.0), dtype=np.uint8
        )

    def _irradiance(self, light: Vector) -> npt.NDArray[np.float32]:
        steps = (np.arange(_LIGHT_GRID) + 0.5) / _LIGHT_GRID
        points = self.corner + steps[:, None, None] * self.edge_v + steps[None, :, None] * self.edge_u
        return np.asarray(_AMBIENT + lamp_light(points, self.normal, light), dtype=np.float32)


@dataclass(frozen=True, slots=True)
class Box:
    """An upright box in a piece of furniture's own frame: centre on the floor plan, bottom, size; metres."""

    x: float
    y: float
    bottom: float
    size: tuple[float, float, float]
    material: str

    def surfaces(self, T_room_piece: Pose) -> list[Surface]:
        """Its six faces, fronts outward."""
        R, origin = T_room_piece[:3, :3], T_room_piece[:3, 3]
        size = np.array(self.size)
        centre = np.array([self.x, self.y, self.bottom + size[2] / 2])
        faces = []
        for axis in range(3):
            for side in (-1.0, 1.0):
                normal = side * np.eye(3)[axis]
                # Columns run horizontally, rows upwards, so that grain and book spines stand.
                u = np.cross(_UP, normal) if axis < 2 else np.array([side, 0, 0])
                u, v, n = (
                    direction * (np.abs(direction) @ size) for direction in (u, np.cross(normal, u), normal)
                )
                corner = centre + (n - u - v) / 2
                faces.append(Surface(R @ corner + origin, R @ u, R @ v, self.material))
        return faces


def lamp_light(points: Vector, normals: Vector, light: Vector) -> Vector:
    """Lambert's law for one lamp at `light`: what points (..., 3) with normals (..., 3) get of it."""
    to_light = light - points
    distance = np.linalg.norm(to_light, axis=-1)
    cosine = np.clip((to_light * normals).sum(axis=-1) / np.maximum(distance, 1e-6), 0, 1)
    return np.asarray(0.9 * cosine / (1 + (distance / 1.8) ** 2))


def left_in_shadow(points: Vector, normals: Vector, light: Vector) -> Vector:
    """Share of the light (...,) at points that stays when something stands before the lamp."""
    return np.asarray(_AMBIENT / (_AMBIENT + lamp_light(points, normals, light)))
