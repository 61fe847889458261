"""The furnished room around the ring. Room frame: origin on the floor's centre, z up, metres."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_agent.simulator.furniture import LOW, TALL, Piece
from rig_agent.simulator.settings import SimulatorSettings
from rig_agent.simulator.streams import Stream, generator
from rig_agent.simulator.surface import Box, Surface
from rig_protocol.poses import Pose

Vector = npt.NDArray[np.float64]

KEEP_OUT_M = 0.95
"""Half of the square around the rig without furniture: a Kinect measures from 0.5 m on, and people pass."""

_WALL_GAP_M = 0.03  # furniture stands off the wall, so that patterns do not pierce it
_CORNER_M = 0.55  # half of the widest tall piece: nearer to a corner it would stand beside the overlap
_PATTERN_TEXEL_M = 0.002
# Neighbours' fields begin to overlap 0.7 m from the axis: of a screen there they share a few centimetres.
_SCREEN_OFF_M, _SCREEN_M = 0.8, (0.5, 0.04, 2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Wall:
    """A wall seen from inside: lower left corner, unit vector to the right, length, height, inward normal."""

    origin: Vector
    right: Vector
    normal: Vector
    length_m: float
    height_m: float

    def at(self, along_m: float, up_m: float, off_m: float = 0.0) -> Vector:
        """The room point so far along, up and off the wall."""
        return np.asarray(self.origin + along_m * self.right + off_m * self.normal + [0, 0, up_m])

    def piece_pose(self, along_m: float) -> Pose:
        """T_room_piece of furniture standing at this wall."""
        T = np.eye(4)
        # x × y = z makes x point to the left of someone who looks at the wall.
        T[:3, 0], T[:3, 1], T[:3, 3] = -self.right, self.normal, self.at(along_m, 0, _WALL_GAP_M)
        return T


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Surfaces of one room, where the rig stands in it, and its lamp."""

    seed: int
    surfaces: tuple[Surface, ...]
    T_room_rig: Pose
    light: Vector
    walls: tuple[Wall, ...]


def build_scene(settings: SimulatorSettings) -> Scene:
    """The room of these settings; nothing is painted before a camera sees it."""
    rng = generator(settings.seed, Stream.ROOM)
    length, width, height = settings.room_m
    T_room_rig = _rig_pose(rng)
    walls = _walls(length, width, height)
    targets = [_hit(walls, T_room_rig, azimuth) for azimuth in _overlap_azimuths(settings, T_room_rig)]
    surfaces = _shell(rng, settings.room_m, walls)
    surfaces += _furniture(rng, settings, walls, targets, T_room_rig[:3, 3])
    if settings.patterns:
        surfaces += _patterns(rng, settings, walls, targets, float(T_room_rig[2, 3]))
    if settings.screened_overlap is not None:
        surfaces += _screen(T_room_rig, _overlap_azimuths(settings, T_room_rig)[settings.screened_overlap])
    light = np.array([rng.uniform(-0.4, 0.4), rng.uniform(-0.4, 0.4), height - 0.15])
    return Scene(settings.seed, tuple(surfaces), T_room_rig, light, walls)


def _rig_pose(rng: np.random.Generator) -> Pose:
    yaw = rng.uniform(0, 2 * np.pi)
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = (rng.uniform(-0.25, 0.25), rng.uniform(-0.25, 0.25), rng.uniform(1.2, 1.35))
    return T


def _walls(length: float, width: float, height: float) -> tuple[Wall, ...]:
    """The four walls, each with its own right-hand direction seen from inside."""
    walls = []
    for quarter in range(4):
        x, y = ((-1, 0), (0, -1), (1, 0), (0, 1))[quarter]
        along, across = (width, length) if x else (length, width)
        inward, right = np.array([x, y, 0.0]), np.array([-y, x, 0.0])
        origin = -inward * across / 2 - right * along / 2
        walls.append(Wall(origin, right, inward, along, height))
    return tuple(walls)


def _overlap_azimuths(settings: SimulatorSettings, T_room_rig: Pose) -> list[float]:
    yaw = float(np.arctan2(T_room_rig[1, 0], T_room_rig[0, 0]))
    step = np.deg2rad(settings.yaw_step_deg)
    return [yaw + step * (i + 0.5) for i, _ in settings.overlaps]


def _hit(walls: tuple[Wall, ...], T_room_rig: Pose, azimuth: float) -> tuple[int, float]:
    """Which wall a horizontal ray from the rig's axis meets, and how far along it."""
    start, direction = T_room_rig[:3, 3], np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    reach = [
        (wall.origin - start) @ wall.normal / slope if (slope := direction @ wall.normal) < -1e-9 else np.inf
        for wall in walls
    ]
    nearest = int(np.argmin(np.array(reach)))
    point = start + reach[nearest] * direction
    return nearest, float((point - walls[nearest].origin) @ walls[nearest].right)


def _shell(
    rng: np.random.Generator, room_m: tuple[float, float, float], walls: tuple[Wall, ...]
) -> list[Surface]:
    length, width, height = room_m
    x, y = np.array([length, 0, 0]), np.array([0, width, 0])
    low = -(x + y) / 2
    floor = Surface(low, x, y, str(rng.choice(["planks", "carpet"])))
    up = np.array([0, 0, height])
    ceiling = Surface(low + up, y, x, "paint", 0.008)
    sides = [Surface(wall.origin, wall.length_m * wall.right, up, "paint", 0.006) for wall in walls]
    return [floor, ceiling, *sides]


def _furniture(
    rng: np.random.Generator,
    settings: SimulatorSettings,
    walls: tuple[Wall, ...],
    targets: list[tuple[int, float]],
    rig: Vector,
) -> list[Surface]:
    """Tall pieces in front of the blocked overlaps, low ones wherever they fit."""
    taken: list[tuple[Vector, Vector]] = [(rig[:2] - KEEP_OUT_M, rig[:2] + KEEP_OUT_M)]
    surfaces: list[Surface] = []
    blocked = 0
    for target in _overlaps_to_block(rng, walls, targets):
        if blocked < settings.blocked_overlaps:
            placed = _place(TALL[blocked % len(TALL)](rng), walls, target, taken)
            surfaces += placed or []
            blocked += placed is not None
    for maker in LOW:
        piece = maker(rng)
        for _ in range(30):
            wall = int(rng.integers(len(walls)))
            placed = _place(piece, walls, (wall, rng.uniform(0, walls[wall].length_m)), taken)
            if placed is not None:
                surfaces += placed
                break
    return surfaces


def _screen(T_room_rig: Pose, azimuth: float) -> list[Surface]:
    """A plain board on the floor, across a direction from the rig's axis."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    T = np.eye(4)
    T[:2, :2] = [[-s, -c], [c, -s]]  # y points back to the rig
    T[:2, 3] = T_room_rig[:2, 3] + _SCREEN_OFF_M * np.array([c, s])
    return Box(0, 0, 0, _SCREEN_M, "paint").surfaces(T)


def _overlaps_to_block(
    rng: np.random.Generator, walls: tuple[Wall, ...], targets: list[tuple[int, float]]
) -> list[tuple[int, float]]:
    """Overlaps in random order; those that meet a wall too near a corner for furniture come last."""

    def to_corner(target: tuple[int, float]) -> float:
        return min(target[1], walls[target[0]].length_m - target[1])

    order = [targets[i] for i in rng.permutation(len(targets))]
    return sorted(order, key=lambda target: to_corner(target) < _CORNER_M)


def _place(
    piece: Piece, walls: tuple[Wall, ...], target: tuple[int, float], taken: list[tuple[Vector, Vector]]
) -> list[Surface] | None:
    """The piece's surfaces at a wall, or None where something stands already; `taken` grows."""
    wall = walls[target[0]]
    margin = piece.width_m / 2 + 0.05
    T = wall.piece_pose(float(np.clip(target[1], margin, wall.length_m - margin)))
    half = np.abs(T[:2, 0]) * piece.width_m / 2
    front = T[:2, 3] + T[:2, 1] * piece.depth_m
    low, high = np.minimum(T[:2, 3], front) - half, np.maximum(T[:2, 3], front) + half
    if any((low < other_high).all() and (other_low < high).all() for other_low, other_high in taken):
        return None
    taken.append((low, high))
    return [surface for box in piece.boxes for surface in box.surfaces(T)]


def _patterns(
    rng: np.random.Generator,
    settings: SimulatorSettings,
    walls: tuple[Wall, ...],
    targets: list[tuple[int, float]],
    eye_m: float,
) -> list[Surface]:
    """Panels first where neighbours overlap, low and high, then anywhere, until the coverage is spent."""
    budget_m2 = settings.pattern_coverage * sum(wall.length_m * wall.height_m for wall in walls)
    spots = [
        (wall, along + rng.normal(0, 0.06), eye_m + up, 10.0) for up in (-0.5, 0.5) for wall, along in targets
    ]
    spots += [
        (wall, rng.uniform(0, walls[wall].length_m), rng.uniform(0.4, 2.2), 40.0)
        for wall in rng.integers(len(walls), size=60).tolist()
    ]
    panels: list[Surface] = []
    for wall, along, up, tilt_deg in spots:
        size = (rng.uniform(0.7, 0.95), rng.uniform(0.85, 1.05))
        if size[0] * size[1] <= budget_m2:
            angle = np.deg2rad(rng.uniform(-tilt_deg, tilt_deg))
            panels.append(_panel(walls[wall], (along, up), size, angle, off_m=0.004 + 0.0004 * len(panels)))
            budget_m2 -= size[0] * size[1]
    return panels


def _panel(
    wall: Wall, centre: tuple[float, float], size: tuple[float, float], angle: float, off_m: float
) -> Surface:
    """A pattern board turned in the wall's plane, moved so that it does not leave the wall."""
    c, s = np.cos(angle), np.sin(angle)
    reach = (abs(c) * size[0] + abs(s) * size[1]) / 2, (abs(s) * size[0] + abs(c) * size[1]) / 2
    along = float(np.clip(centre[0], reach[0] + 0.02, wall.length_m - reach[0] - 0.02))
    up = float(np.clip(centre[1], reach[1] + 0.02, wall.height_m - reach[1] - 0.02))
    vertical = np.array([0, 0, 1.0])
    u = size[0] * (c * wall.right + s * vertical)
    v = size[1] * (-s * wall.right + c * vertical)
    return Surface(wall.at(along, up, off_m) - (u + v) / 2, u, v, "pattern", _PATTERN_TEXEL_M)
