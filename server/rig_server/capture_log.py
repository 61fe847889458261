"""CaptureLog: what a capture tells its coach, as a view that any thread may read."""

import threading
from dataclasses import replace
from typing import Any

from rig_calib.evaluation import evaluate
from rig_calib.rig_calibration import RigCalibration
from rig_server.calibration_task import Estimate
from rig_server.coach import counted, headline
from rig_server.session_view import Phase, SessionView


class CaptureLog:
    """A `Coach` that writes down; `in_force`: the calibration that a result is compared with."""

    def __init__(self, wanted: int, in_force: RigCalibration | None = None) -> None:
        """`wanted`: complete sets to collect."""
        self._in_force = in_force
        self._begun = 0
        self._changing = threading.Lock()  # two threads tell
        self._view = SessionView(Phase.WAITING, wanted=wanted, stage="waiting for the cameras")

    @property
    def view(self) -> SessionView:
        """How it is now; any thread may ask."""
        return self._view

    def connected(self, cameras: int, expected: int | None) -> None:
        """So many cameras are here."""
        told = f"{cameras} of {expected}" if expected else f"{cameras}"
        self._change(stage=f"waiting for the cameras: {told} here")

    def collected(self, sets: int, wanted: int) -> None:
        """So many complete sets have come."""
        if self._view.phase is Phase.WAITING:
            self._change(stage="")
        phase = Phase.COLLECTING if sets < wanted else Phase.SOLVING
        self._change(phase=phase, sets=sets, wanted=wanted)

    def begun(self, sets: int, last: bool) -> None:
        """A calibration on so many sets begins."""
        self._begun = sets
        if last:
            self._change(phase=Phase.SOLVING)

    def tell(self, stage: str, share: float) -> None:
        """How far it is."""
        self._change(stage=f"on {counted(self._begun, 'set')}: {stage}", share=share)

    def show(self, estimate: Estimate, last: bool) -> None:  # noqa: ARG002  # every estimate is of interest
        """What it has found."""
        self._change(
            headline=headline(estimate.sets, estimate.pairs),
            pairs=estimate.pairs,
            failures=estimate.calibration.failures,
            missed=estimate.missed,
            moved=moved(estimate.calibration, self._in_force),
        )

    def writing(self, stage: str, share: float) -> None:
        """How far the writing of its files is."""
        self._change(stage=stage, share=share)

    def ready(self) -> None:
        """The capture has ended with a result."""
        self._change(phase=Phase.READY, stage="", share=1.0)

    def failed(self, message: str) -> None:
        """It has ended without."""
        self._change(phase=Phase.FAILED, stage="", message=message)

    def _change(self, **changes: Any) -> None:
        with self._changing:
            self._view = replace(self._view, **changes)


def moved(calibration: RigCalibration, in_force: RigCalibration | None) -> dict[int, tuple[float, float]]:
    """By how much (deg, mm) every camera is away from where it was, both rigs aligned as wholes.

    Only cameras that both calibrations place; nothing without another one.
    """
    if in_force is None or not calibration.poses.keys() & in_force.poses.keys():
        return {}
    errors = evaluate(calibration.poses, in_force.poses).cameras
    return {camera_id: (error.deg, error.mm) for camera_id, error in errors.items()}
