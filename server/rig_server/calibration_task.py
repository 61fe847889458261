"""What `--calibrate` is asked to do: the whole rig or one camera of it, how well, and for how long."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rig_calib.accuracy import AccuracyTarget
from rig_calib.calibration import CalibrationResult, calibrate
from rig_calib.coaching import PairSupport, Support, pair_supports, shortfall
from rig_calib.provenance import with_provenance, with_recalibration
from rig_calib.recalibration import find_camera, recalibrate
from rig_calib.rig_calibration import RigCalibration
from rig_calib.stages import Progress
from rig_calib.view import CameraView, views_from_panoramas
from rig_protocol.errors import ConfigurationError
from rig_protocol.frames import PanoramicFrame
from rig_protocol.messages import Hello
from rig_protocol.rig_folder import RigDescription
from rig_server.config import RigSettings


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """A calibration on so many sets, and how well it supports every overlap that the task is about.

    `missed` says by how much it misses the task's target; None when it meets it, or there is none.
    """

    sets: int
    result: CalibrationResult
    views: list[CameraView]
    pairs: tuple[PairSupport, ...]
    missed: str | None

    @property
    def calibration(self) -> RigCalibration:
        """The calibration itself."""
        return self.result.calibration


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationTask:
    """The whole rig, or `camera_id` of the `known` calibration; `coached`: until every overlap holds."""

    settings: RigSettings
    known: RigCalibration | None = None
    camera_id: int | None = None
    coached: bool = False

    def __post_init__(self) -> None:
        """ConfigurationError where sets would repeat frames."""
        if self.settings.synchroniser.policy == "latest":
            raise ConfigurationError(
                'synchroniser.policy = "latest" repeats frames, which a calibration must not: use "partial"'
            )

    @classmethod
    def whole_rig(cls, settings: RigSettings, coached: bool = False) -> "CalibrationTask":
        """Calibrate the whole rig; ConfigurationError for a target that the method cannot judge."""
        if settings.calibration.method == "paper" and cls(settings).target is not None:
            raise ConfigurationError("a target needs a covariance, which method `paper` does not give")
        return cls(settings, coached=coached)

    @classmethod
    def one_camera(
        cls, settings: RigSettings, known: RigCalibration, camera: str, coached: bool = False
    ) -> "CalibrationTask":
        """Find one camera, by name or id, anew; ConfigurationError for one that nobody knows."""
        if settings.calibration.method == "paper":
            raise ConfigurationError("--recalibrate adjusts one camera, which method `paper` does not")
        names = {entry.id: entry.label for entry in settings.cameras}
        if camera.isdecimal():  # one that the calibration could not place, in a rig that lists no cameras
            names.setdefault(int(camera), camera)
        return cls(settings, known, find_camera(camera, known, names), coached)

    @property
    def target(self) -> AccuracyTarget | None:
        """How well every pair shall be known."""
        capture = self.settings.capture
        if capture.target_deg is None and capture.target_mm is None:
            return None
        return AccuracyTarget(capture.target_deg, capture.target_mm)

    def estimate(
        self,
        description: RigDescription,
        panoramas: Sequence[PanoramicFrame],
        warnings: Sequence[str],
        progress: Progress,
    ) -> Estimate:
        """Calibrate on some sets; `warnings` on these come before the calibration's own."""
        views = views_from_panoramas(description, panoramas)
        result = self._solve(views, description, progress)
        calibration = result.calibration
        pairs = pair_supports(calibration, views, self.target, self.camera_id)
        missed = None if self.target is None else shortfall(pairs, self.target)
        calibration = dataclasses.replace(calibration, warnings=(*warnings, *calibration.warnings))
        result = dataclasses.replace(result, calibration=calibration)
        return Estimate(len(panoramas), result, views, pairs, missed)

    def contents(self, estimate: Estimate) -> bool:
        """Whether an estimate passes its gate, meets the target and, coached, leaves no overlap bare."""
        bare = any(pair.support is Support.NOTHING for pair in estimate.pairs)
        return not (estimate.calibration.failures or estimate.missed or (self.coached and bare))

    def stamped(self, estimate: Estimate, hellos: Mapping[int, Hello], source: str) -> RigCalibration:
        """The calibration with the agents' serials, its source, settings, and how it met the target."""
        calibration = self._with_serials(estimate.calibration, hellos)
        origin: dict[str, Any] = {
            "source": source,
            "agents": len(hellos),
            "settings": self.settings.model_dump(mode="json"),
            "agent_software": sorted({hello.software for hello in hellos.values()}),
        }
        if self.target is not None:
            origin["target"] = {"deg": self.target.deg, "mm": self.target.mm, "missed": estimate.missed}
        if self.known is None or self.camera_id is None:
            return with_provenance(calibration, **origin)
        return with_recalibration(calibration, self.known, self.camera_id, estimate.sets, **origin)

    def _with_serials(self, calibration: RigCalibration, hellos: Mapping[int, Hello]) -> RigCalibration:
        """The calibration with the serial numbers of the cameras that it was about."""
        cameras = tuple(
            dataclasses.replace(camera, serial=hellos[camera.id].serial)
            if camera.id in hellos and self.camera_id in (None, camera.id)
            else camera
            for camera in calibration.cameras
        )
        return dataclasses.replace(calibration, cameras=cameras)

    def _solve(
        self, views: Sequence[CameraView], description: RigDescription, progress: Progress
    ) -> CalibrationResult:
        settings = self.settings.calibration
        if self.known is None or self.camera_id is None:
            return calibrate(views, description.ring, settings, progress)
        return recalibrate(views, self.known, self.camera_id, description.ring, settings, progress)
