"""What the watch holds of two neighbours: their overlap, and what it showed when their views were learnt."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rig_calib.drift.hypotheses import EdgeEvidence
from rig_calib.drift.look import Look, mean_look
from rig_calib.drift.motion import Motion
from rig_calib.drift.movement_test import displacement_form
from rig_calib.drift.overlap_motion import Overlap, OverlapView, find_overlap
from rig_calib.drift.reference import Reference
from rig_calib.drift.relocation import relocate
from rig_calib.drift.watched_camera import WatchedCamera
from rig_protocol.poses import Pose, inverse, se3_exp, se3_log

Array = npt.NDArray[np.float64]
Seen = tuple[tuple[Look, Look], tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]]


def _variances(deg: float, mm: float) -> Array:
    return np.diag(np.repeat([np.deg2rad(deg), mm / 1e3], 3) ** 2)


_CALIBRATION = _variances(0.1, 3.0)  # what it leaves of a pair, unless it says otherwise
_OTHER_SCENE = _variances(0.12, 3.0)  # what lens and depth errors make of it where other things are looked at
_SAME_SCENE = _variances(0.03, 1.5)
_BUMP = _variances(0.5, 20.0)
_SYSTEMATIC = 4.0  # variance of an overlap's motion over what its noise and its lens floor alone would leave
_LEAST_AGREEMENT = 0.6
# Where both images are little alike, or have become so, shifts were found that are none.
_LEAST_LIKENESS, _LIKENESS_KEPT = 0.5, 0.6
_AVERAGED = 4  # looks: who walks by is somewhere else in each, and none of these places counts
_ATTEMPTS = 4  # at finding where both cameras are


class WatchedPair:
    """Motion of j against the calibration, i in its place: `first` when their views were learnt, `latest`."""

    def __init__(self, i: int, j: int, T_i_j: Pose, covariance: Array | None) -> None:
        """`covariance` (6,6) of T_i_j, on its right, where the calibration states it."""
        self.i, self.j = i, j
        self._T_j_i = inverse(T_i_j)
        self._calibration = _OTHER_SCENE + (_CALIBRATION if covariance is None else covariance)
        self._overlap: Overlap | None = None
        self._views = self._first_views = (0, 0)
        self._least_likeness = _LEAST_LIKENESS
        self.first: Motion | None = None
        self.latest: Motion | None = None

    def is_new(self, a: WatchedCamera, b: WatchedCamera) -> bool:
        """Whether the views of i and j are known, and their overlap was never looked for."""
        return self._views == (0, 0) and a.times_learnt > 0 and b.times_learnt > 0

    def look(self, a: WatchedCamera, b: WatchedCamera, looks: int) -> None:
        """Measure the overlap in the latest looks of cameras i and j."""
        self.latest = None
        if a.reference is None or b.reference is None or not (a.recent and b.recent):
            return
        views = (a.times_learnt, b.times_learnt)
        if views != self._views or (self._overlap is None and not (a.suspected or b.suspected)):
            self._overlap, self._views = self._find(a.reference, b.reference, _latest(a, b, looks)), views
        view = None if self._overlap is None else self._overlap.view(*_latest(a, b, looks))
        if self._overlap is None or view is None or not self._is_plausible(view):
            return
        found = se3_log(self._T_j_i @ inverse(self._overlap.T_j_i))
        self.latest = replace(view.motion, delta=found + view.motion.delta)
        if self.first is None and not (a.suspected or b.suspected):  # one of them may have moved already
            self.first, self._first_views = self.latest, views
            self._least_likeness = _LIKENESS_KEPT * view.likeness

    def against_calibration(self) -> EdgeEvidence | None:
        """What the first look at the overlap says about the calibration."""
        if self.first is None:
            return None
        covariance = _SYSTEMATIC * np.linalg.inv(self.first.information) + self._calibration
        return EdgeEvidence(self.i, self.j, self._T_j_i, self.first.delta, covariance)

    def since_first(self) -> EdgeEvidence | None:
        """What the overlap says about the time since the first look."""
        if self.first is None or self.latest is None:
            return None
        noise = np.linalg.inv(self.first.information) + np.linalg.inv(self.latest.information)
        same = self._views == self._first_views
        covariance = noise + _SAME_SCENE if same else _SYSTEMATIC * noise + _OTHER_SCENE
        return EdgeEvidence(self.i, self.j, self._T_j_i, self.latest.delta - self.first.delta, covariance)

    def _find(self, i: Reference, j: Reference, seen: Seen) -> Overlap | None:
        """The overlap with both cameras where they are: T_j_i is led from the calibration's to what fits."""
        T_j_i: Pose | None = self._T_j_i
        for attempt in range(_ATTEMPTS):
            overlap = None if T_j_i is None else find_overlap(i, j, T_j_i)
            view = None if overlap is None else overlap.view(*seen, far=attempt == 0)
            if view is not None and self._is_plausible(view) and attempt:
                return overlap
            if view is not None and overlap is not None and attempt == 0:
                T_j_i = se3_exp(-view.motion.delta) @ overlap.T_j_i
            else:  # too far for shifts to be followed
                T_j_i = relocate(i, seen[0][1].contrast, j.known.model.color)
        return None

    def _is_plausible(self, view: OverlapView) -> bool:
        return view.motion.agreement >= _LEAST_AGREEMENT and view.likeness >= self._least_likeness

    def residual(self) -> tuple[float, float] | None:
        """By how much what both see lies apart, root mean square, mm and degrees; None if unknown.

        Directions that the overlap leaves open count as far as a bump is likely to have gone in them.
        """
        if self._overlap is None or self.latest is None:
            return None
        information = self.latest.information / _SYSTEMATIC
        delta = np.linalg.solve(information + np.linalg.inv(_BUMP), information @ self.latest.delta)
        points = self._overlap.points
        apart_mm = float(np.sqrt(delta @ displacement_form(points) @ delta))
        return apart_mm, float(np.rad2deg(apart_mm / 1e3 / np.linalg.norm(points, axis=1).mean()))


def _latest(a: WatchedCamera, b: WatchedCamera, count: int) -> Seen:
    """Mean of the stillest of the latest `count` looks of both cameras, and which blocks were still then."""
    looks, still = [], []
    for camera in (a, b):
        latest = sorted(list(camera.recent)[-count:], key=lambda one: -int(one[1].sum()))[:_AVERAGED]
        looks.append(mean_look([look for look, _ in latest]))
        still.append(np.asarray(np.logical_and.reduce([mask for _, mask in latest])))
    return (looks[0], looks[1]), (still[0], still[1])
