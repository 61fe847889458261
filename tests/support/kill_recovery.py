"""When a rig is whole again after its agents were killed, from what its server delivered."""

from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

ALLOWED_S = 5.0
"""A camera may be away from the kill until so long after its agent was ready again."""
_IN_A_ROW = 10  # sets that must be whole: a first frame alone is no stream


@dataclass(frozen=True, slots=True)
class DeliveredSet:
    """When, and the ids of the cameras that it lacks."""

    time_s: float
    missing: AbstractSet[int]


@dataclass(frozen=True, slots=True)
class Kill:
    """One agent ended by a signal, started again, and ready again as it told its service manager."""

    camera: int
    signal: str
    kill_s: float
    restart_s: float
    ready_s: float

    def excuses(self, time_s: float) -> bool:
        """Whether its camera may be away then."""
        return self.kill_s <= time_s <= self.ready_s + ALLOWED_S


def whole_since(kill: Kill, kills: Sequence[Kill], sets: Sequence[DeliveredSet]) -> float | None:
    """When the first of some sets in a row came that hold the camera again; None: none did.

    They lack at most cameras whose agents another kill keeps away, no longer than is allowed.
    """
    return _first_in_a_row(kill, sets, lambda one: one.missing <= _excused(kills, one) - {kill.camera})


def camera_since(kill: Kill, sets: Sequence[DeliveredSet]) -> float | None:
    """When the first of some sets in a row came that hold the camera, whatever else they lack."""
    return _first_in_a_row(kill, sets, lambda one: kill.camera not in one.missing)


def complete_since(kill: Kill, sets: Sequence[DeliveredSet]) -> float | None:
    """When the first set of all cameras came after the restart; None: none did."""
    return next((one.time_s for one in sets if one.time_s >= kill.restart_s and not one.missing), None)


def unexplained(kills: Sequence[Kill], sets: Sequence[DeliveredSet]) -> list[DeliveredSet]:
    """Sets that lack a camera which no kill excuses."""
    return [one for one in sets if not one.missing <= _excused(kills, one)]


def _first_in_a_row(
    kill: Kill, sets: Sequence[DeliveredSet], fits: Callable[[DeliveredSet], bool]
) -> float | None:
    run: list[float] = []
    for one in sets:
        if one.time_s >= kill.restart_s:
            run = [*run, one.time_s] if fits(one) else []
        if len(run) == _IN_A_ROW:
            return run[0]
    return None


def _excused(kills: Sequence[Kill], one: DeliveredSet) -> set[int]:
    return {kill.camera for kill in kills if kill.excuses(one.time_s)}
