"""A calibration that is being made, as others may see it: a snapshot that any thread may read."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from rig_calib.coaching import PairSupport


class Phase(StrEnum):
    """What a calibration is at: `ready` waits for a person to accept or reject."""

    IDLE = "idle"
    WAITING = "waiting"
    COLLECTING = "collecting"
    SOLVING = "solving"
    READY = "ready"
    FAILED = "failed"


@dataclass(frozen=True, slots=True, eq=False)
class SessionView:
    """A calibration at one moment.

    `sets` complete ones of `wanted` are in; the solver does `stage` and is at `share` (0..1) of it.
    `headline`, `pairs`, `missed` (by how much the target is) and `failures` (of the gate) are of the latest
    estimate, as the coach has it. `moved`: by how much (deg, mm) its cameras are away from the calibration in
    force, both rigs aligned as wholes, by camera id. `message`: why it failed, or what became of it.
    """

    phase: Phase = Phase.IDLE
    sets: int = 0
    wanted: int = 0
    stage: str = ""
    share: float = 0.0
    headline: str | None = None
    pairs: tuple[PairSupport, ...] = ()
    failures: tuple[str, ...] = ()
    missed: str | None = None
    moved: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    message: str | None = None
