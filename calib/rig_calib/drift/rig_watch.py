"""A watch of a whole rig: from panoramic frames and a calibration to what has moved."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import cycle, islice

from rig_calib.drift.frame_looks import look_of_frame
from rig_calib.drift.reference import CameraKnown
from rig_calib.drift.watch import DriftStatus, DriftWatch
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.frames import PanoramicFrame
from rig_protocol.rig_folder import RigDescription

MIN_LOOKS = 6
"""So many looks speak for a motion before it is told."""


class RigWatch:
    """Takes panoramic frames; a camera is watched from its first whole frame on."""

    def __init__(self, calibration: RigCalibration) -> None:
        self._calibration = calibration
        covariances = {
            (edge.i, edge.j): edge.relative_covariance
            for edge in calibration.edges
            if edge.relative_covariance is not None
        }
        self._watch = DriftWatch(calibration.poses, covariances)

    def take(self, description: RigDescription, panorama: PanoramicFrame) -> None:
        """Look at one panoramic frame; `description` holds the cameras' models."""
        models = {camera.id: camera.model for camera in description.cameras}
        looks = {}
        for k, frame in panorama.frames.items():
            calibrated = self._calibration.camera(k)
            look = None if calibrated is None or k not in models else look_of_frame(models[k], frame)
            if look is None or calibrated is None or frame is None:
                continue
            known = CameraKnown(models[k], calibrated.depth_correction, frame.depth_frame)
            self._watch.add_camera(k, known)
            looks[k] = look
        self._watch.take(looks)

    def learn(self) -> None:
        """Learn from what was taken so far."""
        self._watch.learn()

    @property
    def looks(self) -> int:
        """How many panoramic frames it has taken."""
        return self._watch.looks

    def recognises(self) -> bool:
        """Whether most cameras see what they have learnt."""
        return self._watch.recognising * 2 > len(self._watch.cameras)

    def status(self) -> DriftStatus:
        """What is known now."""
        return self._watch.status()


@dataclass(frozen=True, slots=True)
class Check:
    """What frames say about a calibration; `unknown`: cameras of it of which they say nothing."""

    status: DriftStatus
    unknown: tuple[int, ...]


def check(
    calibration: RigCalibration,
    description: RigDescription,
    panoramas: Iterable[PanoramicFrame],
    reference: Iterable[PanoramicFrame] = (),
) -> Check:
    """Which cameras of a rig have moved since its calibration, going by frames taken now.

    `reference`: frames taken right after the calibration, from the same place and in the same room; with
    them far smaller motions are seen. Where most cameras do not recognise them they are left out.
    """
    now, before = RigWatch(calibration), RigWatch(calibration)
    for panorama in reference:
        before.take(description, panorama)
    before.learn()
    first: list[PanoramicFrame] = []
    for panorama in panoramas:
        now.take(description, panorama)
        if before.looks:
            before.take(description, panorama)
        if len(first) < MIN_LOOKS:
            first.append(panorama)
    now.learn()
    if before.looks and len(first) < MIN_LOOKS:
        for panorama in islice(cycle(first), MIN_LOOKS):  # a passer-by cannot be told from a bump in so few
            before.take(description, panorama)
    if before.recognises():
        return _result(calibration, before.status(), before.status().judged)
    status = now.status()
    compared = (camera.camera for camera in status.cameras if camera.compared)
    return _result(calibration, status, frozenset(compared))


def _result(calibration: RigCalibration, status: DriftStatus, known: frozenset[int]) -> Check:
    known |= {camera.camera for camera in status.moved}
    return Check(status, tuple(k for k in calibration.poses if k not in known))
