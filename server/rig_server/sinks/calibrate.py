"""The calibrating sink: collects panoramic frames, then calibrates on them."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

from rig_calib.calibration import CalibrationResult, calibrate
from rig_calib.provenance import with_provenance
from rig_calib.rig_calibration import RigCalibration
from rig_calib.settings import CalibrationSettings
from rig_calib.stages import Progress
from rig_calib.view import CameraView, views_from_panoramas
from rig_protocol.errors import RigError
from rig_protocol.frames import PanoramicFrame
from rig_protocol.messages import Hello
from rig_protocol.rig_folder import RigDescription
from rig_server.config import RigSettings


class CalibrateSink:
    """Wants `count` sets that hold an undamaged frame of each of the `cameras`.

    Keeps the least incomplete of the others for want of better.
    """

    def __init__(self, count: int, cameras: Iterable[int]) -> None:
        self._count = count
        self._cameras = tuple(cameras)
        self._complete: list[PanoramicFrame] = []
        self._partial: list[PanoramicFrame] = []

    def take(self, panorama: PanoramicFrame) -> bool:
        """Keep the set; False when there are enough complete ones."""
        if not self._lacking(panorama):
            self._complete.append(panorama)
        else:
            best_first = sorted([*self._partial, panorama], key=lambda one: len(self._lacking(one)))
            self._partial = best_first[: self._count]
        return len(self._complete) < self._count

    @property
    def complete(self) -> int:
        """How many complete sets there are."""
        return len(self._complete)

    def chosen(self) -> tuple[list[PanoramicFrame], tuple[str, ...]]:
        """The sets to calibrate on, and a warning where partial ones had to do; RigError for none at all."""
        if not (self._complete or self._partial):
            raise RigError(
                "the cameras are connected but no frame has arrived: look at `journalctl -u rig-agent` on "
                "their machines"
            )
        spare = self._partial[: self._count - len(self._complete)]
        chosen = sorted([*self._complete, *spare], key=lambda panorama: panorama.index)
        return chosen, self._warnings(len(chosen), spare)

    def calibrate(
        self, description: RigDescription, settings: CalibrationSettings, progress: Progress
    ) -> tuple[CalibrationResult, list[CameraView]]:
        """Calibrate on the chosen sets; this sink's warnings come before the calibration's own."""
        panoramas, warnings = self.chosen()
        views = views_from_panoramas(description, panoramas)
        result = calibrate(views, description.ring, settings, progress)
        calibration = dataclasses.replace(
            result.calibration, warnings=(*warnings, *result.calibration.warnings)
        )
        return dataclasses.replace(result, calibration=calibration), views

    def _lacking(self, panorama: PanoramicFrame) -> list[int]:
        """Cameras of which the set holds no frame, or a damaged one."""
        frames = ((camera_id, panorama.frames.get(camera_id)) for camera_id in self._cameras)
        return [camera_id for camera_id, frame in frames if frame is None or frame.damaged]

    def _warnings(self, frames: int, spare: Sequence[PanoramicFrame]) -> tuple[str, ...]:
        if not spare:
            return ()
        lacking = sorted({camera_id for panorama in spare for camera_id in self._lacking(panorama)})
        warning = (
            f"{len(spare)} of {frames} panoramic frames were partial: complete sets did not come in time; "
            f"missing or damaged at times: cameras {', '.join(map(str, lacking))}"
        )
        return (warning,)


def with_agents(
    calibration: RigCalibration, hellos: Mapping[int, Hello], settings: RigSettings, source: str
) -> RigCalibration:
    """The same calibration with what the agents told, its source and the settings of the server."""
    cameras = tuple(
        dataclasses.replace(camera, serial=hellos[camera.id].serial) if camera.id in hellos else camera
        for camera in calibration.cameras
    )
    return with_provenance(
        dataclasses.replace(calibration, cameras=cameras),
        source,
        len(hellos),
        settings.model_dump(mode="json"),
        agent_software=sorted({hello.software for hello in hellos.values()}),
    )
