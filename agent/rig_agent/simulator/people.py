"""People who walk through the room, always: upright cuboids on a seeded round between rig and furniture."""

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
import numpy.typing as npt

from rig_agent.simulator.scene import KEEP_OUT_M, Scene
from rig_agent.simulator.settings import SimulatorSettings
from rig_agent.simulator.streams import Stream, generator
from rig_agent.simulator.surface import Box, Surface
from rig_protocol.poses import Pose, inverse, transform_points

Vector = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_AZIMUTHS = 72  # directions in which the free floor is looked at
_TALLEST_M = 1.9
_ELBOW_ROOM_M = 0.32  # from the middle of a person to what stands around
_ROUNDING = 4  # directions to both sides over which a corner is rounded
_TURNS = 40  # stretches of walking or standing after which the round repeats
_STRIDE_M = 1.4  # two steps
_STEP_M = 0.18  # by which a foot leads
_TEXTURE_SEEDS = 1_000_003  # clothes are nobody's wallpaper


@dataclass(frozen=True, eq=False)
class Standing:
    """One person at one moment."""

    boxes: tuple[Box, ...]
    T_room_person: Pose
    texture_seed: int

    @cached_property
    def surfaces(self) -> tuple[Surface, ...]:
        """The faces of all boxes, in the room."""
        return tuple(surface for box in self.boxes for surface in box.surfaces(self.T_room_person))

    @property
    def corners(self) -> Vector:
        """Corners (8,3) of a box in the room that holds the whole person."""
        low = np.min([_low(box) for box in self.boxes], axis=0)
        high = np.max([_low(box) + box.size for box in self.boxes], axis=0)
        corners = np.array(list(product(*zip(low, high, strict=True))), dtype=np.float64)
        return transform_points(self.T_room_person, corners)

    def blocks(self, points: Vector, source: Vector) -> Mask:
        """Which points (N,3) of the room get no light from the source (3,), because the person is between.

        Slabs: a segment s → p meets a box when it is inside all three pairs of planes at once.
        """
        T = inverse(self.T_room_person)
        start = T[:3, :3] @ source + T[:3, 3]
        ends = (T[:3, :3] @ points.T + T[:3, 3:]).astype(np.float32)
        inverse_along = 1 / (ends - start[:, None].astype(np.float32) + np.float32(1e-9))
        blocked = np.zeros(len(points), bool)
        for box in self.boxes:
            enter, leave = np.full(len(points), 0, np.float32), np.full(len(points), 0.999, np.float32)
            for axis, (low, size) in enumerate(zip(_low(box), box.size, strict=True)):
                one = np.float32(low - start[axis]) * inverse_along[axis]
                other = np.float32(low + size - start[axis]) * inverse_along[axis]
                enter = np.maximum(enter, np.minimum(one, other))
                leave = np.minimum(leave, np.maximum(one, other))
            blocked |= enter < leave
        return blocked


def _low(box: Box) -> Vector:
    return np.array([box.x - box.size[0] / 2, box.y - box.size[1] / 2, box.bottom])


class People:
    """Everybody in the room, at any time."""

    def __init__(self, settings: SimulatorSettings, scene: Scene) -> None:
        free_m = _free_floor_m(scene) if settings.people else np.empty(0)
        self._walkers = [_Walker(settings.seed, number, scene, free_m) for number in range(settings.people)]

    def at(self, time_s: float) -> list[Standing]:
        """Where everybody is."""
        return [walker.at(time_s) for walker in self._walkers]


class _Walker:
    """One person's round about the rig: now this way, now that, now standing."""

    def __init__(self, seed: int, number: int, scene: Scene, free_m: Vector) -> None:
        rng = generator(seed, Stream.PEOPLE, number)
        self._texture_seed = seed + _TEXTURE_SEEDS * (number + 1)
        self._centre = scene.T_room_rig[:2, 3]
        self._height = rng.uniform(0.92, 1.1)
        share = 0.5 + 0.5 * np.sin(np.arange(_AZIMUTHS) * 2 * np.pi / _AZIMUTHS + rng.uniform(0, 2 * np.pi))
        inner = KEEP_OUT_M + _ELBOW_ROOM_M / 2
        self._radius_m = _smooth(inner + share * np.maximum(free_m - _ELBOW_ROOM_M - inner, 0))
        duration_s, speed_m_s = rng.uniform(2, 8, _TURNS), rng.uniform(0.6, 1.3, _TURNS)
        speed_m_s *= rng.choice((-1, 1, 1, 0), _TURNS)
        self._times_s = np.concatenate([[0], np.cumsum(duration_s)])
        turned = speed_m_s * duration_s / self._radius_m.mean()
        self._angles = rng.uniform(0, 2 * np.pi) + np.concatenate([[0], np.cumsum(turned)])
        self._forward = np.where(speed_m_s < 0, -1.0, 1.0)

    def at(self, time_s: float) -> Standing:
        period_s = self._times_s[-1]
        rounds, within_s = divmod(time_s, period_s)
        angle = np.interp(within_s, self._times_s, self._angles) + rounds * (
            self._angles[-1] - self._angles[0]
        )
        turn = int(np.searchsorted(self._times_s, within_s, side="right")) - 1
        radius = self._radius(angle)
        T = np.eye(4)
        T[:2, 3] = self._centre + radius * np.array([np.cos(angle), np.sin(angle)])
        ahead = self._radius(angle + 0.01) * np.array([np.cos(angle + 0.01), np.sin(angle + 0.01)])
        ahead = self._forward[min(turn, _TURNS - 1)] * (ahead + self._centre - T[:2, 3])
        T[:2, 0] = ahead / np.linalg.norm(ahead)
        T[:2, 1] = -T[1, 0], T[0, 0]
        boxes = _body(self._height, _STEP_M * np.sin(2 * np.pi * angle * self._radius_m.mean() / _STRIDE_M))
        return Standing(boxes, T, self._texture_seed)

    def _radius(self, angle: float) -> float:
        azimuths = np.arange(_AZIMUTHS) * 2 * np.pi / _AZIMUTHS
        return float(np.interp(angle, azimuths, self._radius_m, period=2 * np.pi))


def _body(height: float, step_m: float) -> tuple[Box, ...]:
    """Two legs, a torso with its arms, a head; x is ahead."""
    hip, neck = 0.84 * height, 1.46 * height
    return (
        Box(step_m, 0.1, 0, (0.16, 0.15, hip), "fabric"),
        Box(-step_m, -0.1, 0, (0.16, 0.15, hip), "fabric"),
        Box(0, 0, hip, (0.24, 0.46, neck - hip), "fabric"),
        Box(0.02, 0, neck, (0.2, 0.16, 0.25 * height), "paint"),
    )


def _smooth(radius_m: Vector) -> Vector:
    """The round without corners: the mean over directions of the least radius around each of them."""
    shifts = range(-_ROUNDING, _ROUNDING + 1)
    least = np.min([np.roll(radius_m, shift) for shift in shifts], axis=0)
    return np.asarray(np.mean([np.roll(least, shift) for shift in shifts], axis=0))


def _free_floor_m(scene: Scene) -> Vector:
    """Distance (_AZIMUTHS,) from the rig's axis up to which a person finds room in each direction."""
    start = scene.T_room_rig[:2, 3]
    corners = np.array([surface.corners for surface in scene.surfaces])
    corners = corners[corners[..., 2].min(axis=1) < _TALLEST_M]
    sides = np.stack([corners[:, :, :2], np.roll(corners[:, :, :2], -1, axis=1)], axis=2).reshape(-1, 2, 2)
    free = np.empty(_AZIMUTHS)
    for number, azimuth in enumerate(np.arange(_AZIMUTHS) * 2 * np.pi / _AZIMUTHS):
        free[number] = _nearest_m(start, np.array([np.cos(azimuth), np.sin(azimuth)]), sides)
    beside = int(np.ceil(np.arcsin(_ELBOW_ROOM_M / KEEP_OUT_M) / (2 * np.pi / _AZIMUTHS)))
    turned = [np.roll(free, shift) for shift in range(-beside, beside + 1)]
    return np.asarray(np.min(turned, axis=0))


def _nearest_m(start: Vector, direction: Vector, sides: Vector) -> float:
    """Distance at which a ray on the floor plan first crosses one of the segments (N,2,2)."""
    a, edge = sides[:, 0] - start, sides[:, 1] - sides[:, 0]
    across = direction[0] * edge[:, 1] - direction[1] * edge[:, 0]
    crossing = np.abs(across) > 1e-9
    a, edge, across = a[crossing], edge[crossing], across[crossing]
    distance = (a[:, 0] * edge[:, 1] - a[:, 1] * edge[:, 0]) / across
    place = (a[:, 0] * direction[1] - a[:, 1] * direction[0]) / across
    met = (distance > 0) & (place >= 0) & (place <= 1)
    return float(distance[met].min(initial=20.0))
