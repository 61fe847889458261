"""DriftWatch: looks at the rig's frames and says which camera is no longer where calibration found it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from rig_calib.drift.hypotheses import MovedCamera, moved_cameras, support
from rig_calib.drift.look import Look
from rig_calib.drift.reference import CameraKnown
from rig_calib.drift.rig_motion import motion_in_rig, rig_motion
from rig_calib.drift.watched_camera import RECENT_LOOKS, WatchedCamera
from rig_calib.drift.watched_pair import WatchedPair
from rig_calib.overlap import shared_regions
from rig_protocol.poses import Pose, inverse

Array = npt.NDArray[np.float64]
State = Literal["learning", "in place", "moved", "not seen"]
Evidence = Literal["its own view", "its overlaps", "the calibration"]

_LEAST_SHARE = 0.08  # of an image that neighbours have in common
_CONFIRMING_LOOKS = 5  # all of them after the bump
_CONTRADICTION = -9.0  # χ² by which overlaps speak against what a camera's own view says
_CHI2, _CHI2_CALIBRATION = 40.0, 45.0
_ROUNDS = 3  # of all overlaps that must agree where a camera's own view tells nothing


@dataclass(frozen=True, slots=True, eq=False)
class CameraDrift:
    """One camera at one moment.

    `deg`, `mm`: size of its rotation and translation, with standard deviations; 0 until it moved. `found_by`:
    what told of it. `rivals`: cameras whose motion would explain as much. `compared`: whether an overlap was
    compared with the calibration; else the watch knows only of the time since it began.
    """

    camera: int
    state: State
    deg: float = 0.0
    mm: float = 0.0
    sigma_deg: float = 0.0
    sigma_mm: float = 0.0
    found_by: Evidence | None = None
    rivals: tuple[int, ...] = ()
    compared: bool = False


@dataclass(frozen=True, slots=True)
class PairDrift:
    """What both cameras of a pair see lies so far apart, root mean square; None where that is too little."""

    i: int
    j: int
    mm: float | None = None
    deg: float | None = None


@dataclass(frozen=True, slots=True)
class DriftStatus:
    """All cameras and pairs; `rig_mm`: by how much the whole rig was moved since its views were learnt."""

    cameras: tuple[CameraDrift, ...] = ()
    pairs: tuple[PairDrift, ...] = ()
    rig_mm: float = 0.0
    looks: int = 0

    @property
    def judged(self) -> frozenset[int]:
        """Cameras of which something tells where they are."""
        return frozenset(one.camera for one in self.cameras if one.state in ("in place", "moved"))

    @property
    def moved(self) -> tuple[CameraDrift, ...]:
        """The cameras that moved."""
        return tuple(camera for camera in self.cameras if camera.state == "moved")


class DriftWatch:
    """Watches the cameras that the calibration placed; `take` one look of each at a time."""

    def __init__(
        self, poses: Mapping[int, Pose], covariances: Mapping[tuple[int, int], Array] | None = None
    ) -> None:
        """`poses`: T_rig_camera of the calibration; `covariances` (6,6): of T_i_j, i < j, on its right."""
        self._poses = dict(poses)
        self._covariances = covariances or {}
        self._known: dict[int, CameraKnown] = {}
        self._cameras: dict[int, WatchedCamera] = {}
        self._pairs: list[WatchedPair] = []
        self.looks = 0
        self._rig_mm = 0.0
        self._suspected: dict[int, int] = {}
        self._by_overlaps: dict[int, MovedCamera] = {}
        self._before: dict[int, MovedCamera] = {}

    def add_camera(self, k: int, known: CameraKnown) -> None:
        """Watch one more camera, if the calibration placed it."""
        if k not in self._poses or k in self._cameras:
            return
        self._known[k] = known
        self._cameras[k] = WatchedCamera(known)
        poses = {i: self._poses[i] for i in self._known}
        for i, j in neighbours(poses, self._known):
            if k in (i, j):
                T_i_j = inverse(poses[i]) @ poses[j]
                self._pairs.append(WatchedPair(i, j, T_i_j, self._covariances.get((i, j))))

    @property
    def recognising(self) -> int:
        """How many cameras saw, in their latest look, the room that they have learnt."""
        return sum(camera.motion is not None for camera in self._cameras.values())

    @property
    def cameras(self) -> tuple[int, ...]:
        """Those that are watched."""
        return tuple(self._cameras)

    def take(self, looks: Mapping[int, Look]) -> None:
        """One look of every camera that has one."""
        self.looks += 1
        for k, look in looks.items():
            if k in self._cameras:
                self._cameras[k].see(look)
        self._test_views()
        due = self.looks % RECENT_LOOKS
        for number, pair in enumerate(self._pairs):
            new = pair.is_new(self._cameras[pair.i], self._cameras[pair.j])
            if new or number % RECENT_LOOKS == due:  # a few at a time: each takes some 10 ms
                self._look_at(pair)
        if due == 0:
            self._test_overlaps()

    def learn(self) -> None:
        """Learn from what was taken so far, however little that is, and look at every overlap."""
        for camera in self._cameras.values():
            camera.learn()
        for pair in self._pairs:
            self._look_at(pair)
        self._test_overlaps()

    def status(self) -> DriftStatus:
        """What is known now."""
        cameras = tuple(replace(self._drift(k), compared=self._is_compared(k)) for k in self._cameras)
        pairs = tuple(PairDrift(pair.i, pair.j, *(pair.residual() or ())) for pair in self._pairs)
        return DriftStatus(cameras, pairs, self._rig_mm, self.looks)

    def _test_views(self) -> None:
        """What each camera's own view says, less what all of them say together."""
        seen = {k: one.motion for k, one in self._cameras.items() if one.motion is not None and one.test}
        common = rig_motion(seen, self._poses)
        self._rig_mm = 1e3 * float(np.linalg.norm(common[3:]))
        for k, motion in seen.items():
            test = self._cameras[k].test
            if test is None:
                continue
            moved_before = test.moved
            test.add(replace(motion, delta=motion.delta - motion_in_rig(common, self._poses[k])))
            if test.moved and not moved_before and self._contradicted(k, test.estimate[0]):
                self._cameras[k].forget()  # not the camera: what it looks at

    def _contradicted(self, k: int, motion: Array) -> bool:
        edges = []
        for pair in self._pairs:
            if k in (pair.i, pair.j):
                pair.look(self._cameras[pair.i], self._cameras[pair.j], _CONFIRMING_LOOKS)
                edges.append(pair.since_first())
        return support([edge for edge in edges if edge is not None], k, motion) < _CONTRADICTION

    def _test_overlaps(self) -> None:
        """Where cameras are by what their neighbours see: those whose first view is lost, and before that."""
        edges = [edge for pair in self._pairs if (edge := pair.since_first()) is not None]
        found = {
            one.camera: one for one in moved_cameras(edges, _CHI2) if not self._in_first_view(one.camera)
        }
        self._suspected = {k: self._suspected.get(k, 0) + 1 for k in found}
        self._by_overlaps = {k: one for k, one in found.items() if self._suspected[k] >= _ROUNDS}
        before = [edge for pair in self._pairs if (edge := pair.against_calibration()) is not None]
        self._before = {one.camera: one for one in moved_cameras(before, _CHI2_CALIBRATION)}

    def _in_first_view(self, k: int) -> bool:
        camera = self._cameras[k]
        return camera.times_learnt == 1 and camera.motion is not None

    def _is_compared(self, k: int) -> bool:
        return any(pair.first is not None for pair in self._pairs if k in (pair.i, pair.j))

    def _is_judged(self, k: int) -> bool:
        """Whether its own view or an overlap says where it is."""
        return self._cameras[k].motion is not None or any(
            pair.latest is not None for pair in self._pairs if k in (pair.i, pair.j)
        )

    def _look_at(self, pair: WatchedPair) -> None:
        pair.look(self._cameras[pair.i], self._cameras[pair.j], RECENT_LOOKS)

    def _drift(self, k: int) -> CameraDrift:
        camera = self._cameras[k]
        if camera.test is not None and camera.test.moved:
            return _moved(k, *camera.test.estimate, "its own view")
        if k in self._by_overlaps:
            found = self._by_overlaps[k]
            return _moved(k, found.delta, found.covariance, "its overlaps", found.rivals)
        if (before := self._before.get(k)) is not None:
            return _moved(k, before.delta, before.covariance, "the calibration", before.rivals)
        if camera.reference is None:
            return CameraDrift(k, "learning")
        return CameraDrift(k, "in place" if self._is_judged(k) else "not seen")


def neighbours(poses: Mapping[int, Pose], known: Mapping[int, CameraKnown]) -> list[tuple[int, int]]:
    """Pairs that share a good part of their views, going by the calibration."""
    colors = {k: known[k].model.color for k in poses}
    regions = shared_regions(colors, poses, margin_deg=0.0)
    return [
        (i, j)
        for (i, j), (region, _) in regions.items()
        if (region.right - region.left) * (region.bottom - region.top)
        >= _LEAST_SHARE * colors[i].width * colors[i].height
    ]


def _moved(
    k: int, delta: Array, covariance: Array, found_by: Evidence, rivals: tuple[int, ...] = ()
) -> CameraDrift:
    rotation, translation = delta[:3], delta[3:]
    return CameraDrift(
        k,
        "moved",
        deg=float(np.rad2deg(np.linalg.norm(rotation))),
        mm=1e3 * float(np.linalg.norm(translation)),
        sigma_deg=float(np.rad2deg(_sigma_of_norm(rotation, covariance[:3, :3]))),
        sigma_mm=1e3 * _sigma_of_norm(translation, covariance[3:, 3:]),
        found_by=found_by,
        rivals=rivals,
    )


def _sigma_of_norm(vector: Array, covariance: Array) -> float:
    direction = vector / max(float(np.linalg.norm(vector)), 1e-12)
    return float(np.sqrt(direction @ covariance @ direction))
