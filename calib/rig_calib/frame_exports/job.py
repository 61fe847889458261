"""What an export is asked to do, and what it has written."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from rig_calib.offline.capture import Capture
from rig_calib.offline.workers import Tell, Workers
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.errors import ConfigurationError, DataError


@dataclass(frozen=True, slots=True)
class FusionLook:
    """How fused frames shall look: seen from `centre_m` in the rig frame, by default amid the cameras.

    `match_colors`: cameras of different exposure are made to agree, by the first frame that all are in.
    """

    centre_m: tuple[float, float, float] | None = None
    match_colors: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class ExportJob:
    """Positions of a capture, to `out`: a file or a folder, as the format has it.

    `calibration`: the given one, else the capture's own, else None. `fps`: frames a second of a video.
    """

    capture: Capture
    positions: range
    out: Path
    workers: Workers
    calibration: RigCalibration | None = None
    fps: float = 30.0
    look: FusionLook = FusionLook()  # frozen
    tell: Tell = field(default=lambda _share: None)

    def refuse_nothing(self, written: int) -> None:
        """DataError where none of the frames held an image: rather no output than an empty one."""
        if not written:
            raise DataError(
                f"{self.capture.path}: none of the {len(self.positions)} panoramic frames that were asked "
                "for holds an image that can be read: choose others with --first"
            )

    def needed_calibration(self) -> RigCalibration:
        """The calibration; ConfigurationError where there is none."""
        if self.calibration is None:
            raise ConfigurationError(
                f"{self.capture.path} carries no calibration, and this format needs one: name it with "
                "--calibration FILE"
            )
        return self.calibration


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written, and what a person should know of it."""

    paths: tuple[Path, ...]
    notes: tuple[str, ...] = ()


Exporter = Callable[[ExportJob], Exported]
