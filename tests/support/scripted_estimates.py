"""Estimates of a calibration whose outcome a test decides, in place of the solver."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from rig_calib.calibration import CalibrationResult
from rig_calib.coaching import PairSupport, Support
from rig_protocol.frames import PanoramicFrame
from rig_protocol.poses import Pose
from rig_protocol.rig_folder import RigDescription
from rig_server.calibration_task import CalibrationTask, Estimate
from support.box_room import calibration_of


@dataclass
class ScriptedEstimates:
    """Stands for `CalibrationTask.estimate`; remembers on which sets each estimate was made."""

    poses: dict[int, Pose] = field(default_factory=dict)
    failures: tuple[str, ...] = ()
    missed: str | None = None
    error: Exception | None = None
    support: Callable[[Sequence[int]], Support] = lambda _sets: Support.GOOD
    on: list[list[int]] = field(default_factory=list)

    def __call__(
        self,
        _task: CalibrationTask,
        _description: RigDescription,
        panoramas: Sequence[PanoramicFrame],
        warnings: Sequence[str],
        tell: Callable[[str, float], None],
    ) -> Estimate:
        tell("features", 0.5)
        if self.error is not None:
            raise self.error
        sets = [one.index for one in panoramas]
        self.on.append(sets)
        calibration = calibration_of(self.poses, warnings=tuple(warnings), failures=self.failures)
        pair = PairSupport(0, 1, "cam00–cam01", 9, True, None, self.support(sets))
        return Estimate(len(sets), CalibrationResult(calibration, (), {}, None), [], (pair,), self.missed)
