"""What the watch holds of two neighbours: their overlap, and what it showed when their views were learnt."""

import numpy as np
import numpy.typing as npt

from rig_calib.drift.hypotheses import EdgeEvidence
from rig_calib.drift.look import Look, mean_look
from rig_calib.drift.motion import Motion
from rig_calib.drift.movement_test import displacement_form
from rig_calib.drift.overlap_motion import Overlap, find_overlap
from rig_calib.drift.watched_camera import WatchedCamera
from rig_protocol.poses import Pose, inverse

Mask = npt.NDArray[np.bool_]
Array = npt.NDArray[np.float64]


def _variances(deg: float, mm: float) -> Array:
    return np.diag(np.repeat([np.deg2rad(deg), mm / 1e3], 3) ** 2)


# What a calibration leaves of a pair, and of lens and depth errors that move when other things are looked at.
_CALIBRATION = _variances(0.15, 4.0)
_OTHER_SCENE = _variances(0.15, 4.0)
_SAME_SCENE = _variances(0.03, 1.5)
_BUMP = _variances(0.5, 20.0)
_SYSTEMATIC = 4.0  # variance of an overlap's motion over what its noise and its lens floor alone would leave
_LEAST_AGREEMENT = 0.6
# Where both images have become much less alike, shifts were found that are none.
_LIKENESS_KEPT = 0.6


class WatchedPair:
    """`first`: motion of j against the calibration when both views were first learnt, `latest`: now."""

    def __init__(self, i: int, j: int, T_i_j: Pose) -> None:
        self.i, self.j = i, j
        self._T_j_i = inverse(T_i_j)
        self._overlap: Overlap | None = None
        self._views = self._first_views = (0, 0)
        self._least_likeness = -1.0
        self.first: Motion | None = None
        self.latest: Motion | None = None

    def look(self, a: WatchedCamera, b: WatchedCamera, looks: int) -> None:
        """Measure the overlap in the latest looks of cameras i and j."""
        self.latest = None
        if a.reference is None or b.reference is None or not (a.recent and b.recent):
            return
        views = (a.times_learnt, b.times_learnt)
        if views != self._views:
            self._overlap, self._views = find_overlap(a.reference, b.reference, self._T_j_i), views
        view = None if self._overlap is None else self._overlap.view(*_latest(a, b, looks))
        if view is None or view.motion.agreement < _LEAST_AGREEMENT or view.likeness < self._least_likeness:
            return
        self.latest = view.motion
        if self.first is None:
            self.first, self._first_views = view.motion, views
            self._least_likeness = _LIKENESS_KEPT * view.likeness

    def against_calibration(self) -> EdgeEvidence | None:
        """What the first look at the overlap says about the calibration."""
        if self.first is None:
            return None
        covariance = _SYSTEMATIC * np.linalg.inv(self.first.information) + _CALIBRATION
        return EdgeEvidence(self.i, self.j, self._T_j_i, self.first.delta, covariance)

    def since_first(self) -> EdgeEvidence | None:
        """What the overlap says about the time since the first look."""
        if self.first is None or self.latest is None:
            return None
        noise = np.linalg.inv(self.first.information) + np.linalg.inv(self.latest.information)
        same = self._views == self._first_views
        covariance = noise + _SAME_SCENE if same else _SYSTEMATIC * noise + _OTHER_SCENE
        return EdgeEvidence(self.i, self.j, self._T_j_i, self.latest.delta - self.first.delta, covariance)

    def residual_mm(self) -> float | None:
        """By how much what both see lies apart, root mean square; None where nothing is measured.

        Directions that the overlap leaves open count as far as a bump is likely to have gone in them.
        """
        if self._overlap is None or self.latest is None:
            return None
        information = self.latest.information / _SYSTEMATIC
        delta = np.linalg.solve(information + np.linalg.inv(_BUMP), information @ self.latest.delta)
        return float(np.sqrt(delta @ displacement_form(self._overlap.points) @ delta))


def _latest(a: WatchedCamera, b: WatchedCamera, count: int) -> tuple[tuple[Look, Look], tuple[Mask, Mask]]:
    """Mean of the latest looks of both cameras, and which of their depth blocks were still in all of them."""
    parts = [list(camera.recent)[-count:] for camera in (a, b)]
    still = [np.asarray(np.logical_and.reduce([mask for _, mask in part])) for part in parts]
    mean = [mean_look([look for look, _ in part]) for part in parts]
    return (mean[0], mean[1]), (still[0], still[1])
