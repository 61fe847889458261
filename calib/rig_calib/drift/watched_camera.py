"""What the watch holds of one camera: its reference, its latest looks, its test."""

from collections import deque

import numpy as np
import numpy.typing as npt

from rig_calib.drift.look import Look
from rig_calib.drift.motion import Motion
from rig_calib.drift.movement_test import MovementTest
from rig_calib.drift.own_motion import OwnView, compare
from rig_calib.drift.reference import CameraKnown, Reference, learn_reference
from rig_calib.drift.relocation import relocate
from rig_protocol.poses import inverse, se3_log

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

LEARNT_LOOKS = 12
"""Looks of one reference: at one look in four frames, 1.6 s, in which people pass."""
RECENT_LOOKS = 8  # kept for the overlaps: about 0.7 MB each
_LOST_LOOKS = 75  # without a still view, 10 s: the rig was carried away, or the furniture moved
_RELOCATE_EVERY = 4  # looks: it takes some 30 ms
_FAR_MM = 25.0
_LEAST_LANDMARKS = 40
_LEAST_AGREEMENT = 0.5


class WatchedCamera:
    """Takes one look after the other. `times_learnt`: how often its view was learnt, once in a quiet room."""

    def __init__(self, known: CameraKnown) -> None:
        self._known = known
        self._learning: list[Look] = []
        self._lost = self._seen = 0
        self._far: Array | None = None
        self.reference: Reference | None = None
        self.test: MovementTest | None = None
        self.recent: deque[tuple[Look, Mask]] = deque(maxlen=RECENT_LOOKS)
        self.times_learnt = 0
        self.motion: Motion | None = None

    def see(self, look: Look) -> None:
        """One look more: `motion` is what it says, None where it says nothing."""
        self.motion = None
        if self.reference is None:
            self._learning.append(look)
            if len(self._learning) >= LEARNT_LOOKS:
                self.learn()
            return
        if self._out_of_reach and self._seen % _RELOCATE_EVERY == 0:
            T_now_before = relocate(self.reference, look.contrast, self._known.model.color)
            self._far = None if T_now_before is None else se3_log(inverse(T_now_before))
        self._seen += 1
        view = compare(self.reference, look, self._far)
        self.recent.append((look, view.still))
        if _tells(view):
            self.motion, self._lost = view.motion, 0
        else:
            self._lost += 1
            if self._lost >= _LOST_LOOKS and not self._moved:
                self.forget()

    @property
    def suspected(self) -> bool:
        """Whether anything speaks for a motion."""
        return self.test is not None and self.test.evidence > 0

    @property
    def _moved(self) -> bool:
        return self.test is not None and self.test.moved

    @property
    def _out_of_reach(self) -> bool:
        """Covered, or moved by more than what is followed from look to look."""
        far = (
            self.test is not None
            and self.test.moved
            and self.test.displacement_mm(self.test.estimate[0]) > _FAR_MM
        )
        return self._lost > _RELOCATE_EVERY or far

    def learn(self) -> None:
        """Make a reference of the looks there are, when there are any."""
        if self.reference is not None or not self._learning:
            return
        reference = learn_reference(self._known, self._learning)
        recent = self._learning[-RECENT_LOOKS:]
        self.recent.extend((look, compare(reference, look).still) for look in recent)
        self._learning.clear()
        self.times_learnt += 1
        self.reference = reference
        if len(reference.landmarks) >= _LEAST_LANDMARKS:
            self.test = MovementTest(reference.points, reference.looks)

    def forget(self) -> None:
        """The view is another one: learn it anew from the next looks."""
        self.reference = self.test = self.motion = None
        self.recent.clear()
        self._lost, self._far = 0, None


def _tells(view: OwnView) -> bool:
    return view.motion is not None and view.motion.agreement >= _LEAST_AGREEMENT
