"""What an uncertain relative pose means for people: how far apart two cameras put the same point.

A rotation and a translation in one number: millimetres at a distance. Everything is told on the axes of the
room (viewing direction, sideways, vertical), whichever way the cameras lie.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.evaluation import NEAR_LIMIT_DEG
from rig_calib.rig_calibration import CalibratedEdge, RigCalibration
from rig_calib.uncertainty import weakest_direction
from rig_protocol.poses import Pose, hat, inverse, rotation_angle_deg

Array = npt.NDArray[np.float64]

ROOM_DISTANCE_M = 3.0
"""Where the room usually is: sentences and rankings are about points this far away."""

_HEIGHTS = np.tan(np.deg2rad((-20.0, 0.0, 20.0)))  # over the part of a view where neighbours overlap
_MOTIONS = (
    "rolling about the viewing direction",
    "nodding up and down",
    "turning about the vertical axis",
    "sliding along the viewing direction",
    "sliding sideways",
    "sliding up and down",
)
_TURNS = 3  # of the motions above


@dataclass(frozen=True, slots=True)
class WeakestMotion:
    """The motion of one camera against another that is known least, one standard deviation of it.

    `deg` for a turn, `mm` for a slide, the other is None.
    """

    name: str
    deg: float | None
    mm: float | None

    def __str__(self) -> str:
        """As `turning about the vertical axis (0.08°)`."""
        return f"{self.name} ({self.mm:.1f} mm)" if self.deg is None else f"{self.name} ({self.deg:.2f}°)"


@dataclass(frozen=True, slots=True, eq=False)
class PairUncertainty:
    """What is unknown of the pose of camera j against camera i.

    `covariance` (6,6) is of a turn of camera j about its own place and of its shift, on the axes of the room:
    viewing direction of the pair, left, up (see `pair_frame`).
    """

    i: int
    j: int
    covariance: Array
    T_room_j: Pose
    azimuth_rad: float

    @classmethod
    def of(
        cls, i: int, j: int, T_view_i: Pose, T_view_j: Pose, relative_covariance: Array
    ) -> "PairUncertainty":
        """From poses in a frame whose z is up, and the covariance of T_i_j on its right."""
        T_view_room = pair_frame(T_view_i, T_view_j)
        T_room_j = inverse(T_view_room) @ T_view_j
        turn = np.kron(np.eye(2), T_room_j[:3, :3])
        covariance = turn @ relative_covariance @ turn.T
        azimuth_rad = float(np.arctan2(T_view_room[1, 0], T_view_room[0, 0]))
        return cls(i, j, covariance, T_room_j, azimuth_rad)

    @property
    def sigma(self) -> tuple[float, float]:
        """Standard deviations in the least certain directions: degrees, millimetres."""
        deg, m = weakest_direction(self.covariance)
        return deg, m * 1e3

    def displacement_mm(self, distance_m: float) -> float:
        """Root mean square distance between where both cameras put points so far in front of the pair."""
        J = self._by_motion(distance_m)
        return float(np.sqrt(max(np.trace(J @ self.covariance @ J.T), 0.0)) * 1e3)

    def weakest_motion(self, distance_m: float) -> WeakestMotion:
        """What displaces points at this distance most.

        Of the displacements' first principal component, the motion that contributes most to it, as large as
        it is when that component is one standard deviation.
        """
        J = self._by_motion(distance_m)
        variances, directions = np.linalg.eigh(J @ self.covariance @ J.T)
        motion = self.covariance @ J.T @ directions[:, -1] / np.sqrt(max(variances[-1], 1e-30))
        largest = int(np.argmax((directions[:, -1] @ J) * motion))
        amount = abs(float(motion[largest]))
        if largest < _TURNS:
            return WeakestMotion(_MOTIONS[largest], float(np.rad2deg(amount)), None)
        return WeakestMotion(_MOTIONS[largest], None, amount * 1e3)

    def _by_motion(self, distance_m: float) -> Array:
        """Displacements (3P,6), over √P, of P points at this distance by a turn and a shift of camera j."""
        points = np.array([(distance_m, 0.0, distance_m * height) for height in _HEIGHTS])
        lever = points - self.T_room_j[:3, 3]
        J = np.concatenate([-hat(lever), np.broadcast_to(np.eye(3), (len(points), 3, 3))], axis=2)
        return np.asarray(J.reshape(-1, 6) / np.sqrt(len(points)))


def pair_uncertainties(calibration: RigCalibration, T_rig_view: Pose) -> list[PairUncertainty]:
    """Every overlap whose relative pose has a covariance, around the rig; `T_rig_view` has z up.

    An overlap is an edge that was used, or one between cameras that look almost the same way.
    """
    T_view_rig, poses = inverse(T_rig_view), calibration.poses
    pairs = [
        PairUncertainty.of(
            edge.i, edge.j, T_view_rig @ poses[edge.i], T_view_rig @ poses[edge.j], edge.relative_covariance
        )
        for edge in overlaps(calibration)
        if edge.relative_covariance is not None
    ]
    return sorted(pairs, key=lambda pair: pair.azimuth_rad % (2 * np.pi))


def overlaps(calibration: RigCalibration) -> list[CalibratedEdge]:
    """The edges between placed cameras that were used, or should have been: they look almost the same way."""
    poses = calibration.poses
    return [
        edge
        for edge in calibration.edges
        if {edge.i, edge.j} <= poses.keys()
        and (edge.used or rotation_angle_deg(inverse(poses[edge.i]) @ poses[edge.j]) < NEAR_LIMIT_DEG)
    ]


def worst_pair(pairs: Sequence[PairUncertainty], distance_m: float) -> PairUncertainty | None:
    """The pair that displaces points at this distance most; None of none."""
    return max(pairs, key=lambda pair: pair.displacement_mm(distance_m), default=None)


def least_certain(pairs: Sequence[PairUncertainty]) -> PairUncertainty | None:
    """The pair that stands out in figures and tables; None where there is nothing to compare it with."""
    return worst_pair(pairs, ROOM_DISTANCE_M) if len(pairs) > 1 else None


def least_certain_of(pairs: Sequence[PairUncertainty], count: int) -> list[PairUncertainty]:
    """At most so many pairs, the least certain ones, in the order that they have."""
    ranked = sorted(pairs, key=lambda pair: -pair.displacement_mm(ROOM_DISTANCE_M))[:count]
    return [pair for pair in pairs if pair in ranked]


def pair_frame(T_view_i: Pose, T_view_j: Pose) -> Pose:
    """T_view_pair: origin amid two cameras, x where they look on the mean, y left of that and level.

    `T_view_i` and `T_view_j` are poses in a frame whose z is up.
    """
    forward = T_view_i[:3, 2] + T_view_j[:3, 2]
    if np.linalg.norm(forward) < 1e-6:  # back to back
        forward = T_view_i[:3, 2]
    forward = forward / np.linalg.norm(forward)
    left = np.cross((0.0, 0.0, 1.0), forward)
    if np.linalg.norm(left) < 1e-6:  # straight up or down: no direction is more level than another
        left = T_view_i[:3, 0] - forward * (forward @ T_view_i[:3, 0])
    left = left / np.linalg.norm(left)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([forward, left, np.cross(forward, left)])
    T[:3, 3] = (T_view_i[:3, 3] + T_view_j[:3, 3]) / 2
    return T
