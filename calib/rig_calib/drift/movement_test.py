"""The sequential test: has one camera moved, going by all that was seen of it since that began to look so?

A cumulative sum (Page 1954) of log-likelihood ratios between "displaced by 4 mm" and "in place", where the
displacement is that of what the camera sees, root mean square: 0.5° are 5 to 20 mm in a room, 5 mm are 5 mm.
One look counts for little, however clear it is: who passes by disturbs some looks, a bump all that follow.
"""

from collections import deque

import numpy as np
import numpy.typing as npt

from rig_calib.drift.motion import Motion, move_points

Array = npt.NDArray[np.float64]

_ALTERNATIVE_MM = 4.0
_LEAST_SIGMA_MM = 1.0  # light that changes, a Kinect that warms up
_MOST_A_LOOK = 2.0
_ALARM, _FULL = 12.0, 24.0
_LEAST_MM = 2.5
_KEPT = 16
LOOK_FLOOR = np.diag(np.repeat([np.deg2rad(0.01), 0.0005], 3) ** 2)
"""What two looks differ by beyond their noise, (rad, m)²."""


def displacement_form(points: Array) -> Array:
    """Q (6,6): a motion δ displaces points (N,3) seen by δᵀQδ mm², mean square."""
    moved = move_points(points)
    return np.asarray(1e6 * np.einsum("nki,nkj->ij", moved, moved) / max(len(points), 1))


class MovementTest:
    """Takes a camera's motion of each look; `moved` until as much speaks against it."""

    def __init__(self, points: Array, reference_looks: int) -> None:
        self._form = displacement_form(points)
        self._reference_share = 1.0 / reference_looks
        self._since: deque[tuple[Array, Array]] = deque(maxlen=_KEPT)
        self.evidence = 0.0
        self.moved = False

    def add(self, motion: Motion) -> None:
        """One look more."""
        covariance = np.linalg.inv(motion.information) * (1 + self._reference_share) + LOOK_FLOOR
        uncertain = float(np.trace(self._form @ covariance))
        size = max(self.displacement_mm(motion.delta) ** 2 - uncertain, 0.0) ** 0.5
        ratio = _ALTERNATIVE_MM * (size - _ALTERNATIVE_MM / 2) / (_LEAST_SIGMA_MM**2 + uncertain)
        self.evidence = float(np.clip(self.evidence + np.clip(ratio, -_MOST_A_LOOK, _MOST_A_LOOK), 0, _FULL))
        if self.evidence == 0.0:
            self._since.clear()
            self.moved = False
        else:
            self._since.append((motion.delta, np.linalg.inv(covariance)))
        if self.evidence >= _ALARM and self.displacement_mm(self.estimate[0]) >= _LEAST_MM:
            self.moved = True

    @property
    def estimate(self) -> tuple[Array, Array]:
        """Motion (6,) over the latest looks since something spoke for one, and its covariance (6,6)."""
        if not self._since:
            return np.zeros(6), np.zeros((6, 6))
        information, total = np.zeros((6, 6)), np.zeros(6)
        for delta, weight in self._since:
            information += weight
            total += weight @ delta
        covariance: Array = np.asarray(np.linalg.inv(information), dtype=np.float64)
        # The reference is in all of them.
        return covariance @ total, covariance * (1 + self._reference_share * len(self._since))

    def displacement_mm(self, delta: Array) -> float:
        """By how much a motion displaces what the camera sees, root mean square."""
        return float(np.sqrt(delta @ self._form @ delta))
