"""Coach: who is told how a capture goes, and what is told in words."""

from collections.abc import Sequence
from typing import Protocol

from rig_calib.accuracy import Accuracy
from rig_calib.coaching import PairSupport, Support
from rig_server.calibration_task import Estimate


class Coach(Protocol):
    """Is told how a capture goes: a terminal, or whoever else looks on. Two threads tell it."""

    def connected(self, cameras: int, expected: int | None) -> None:
        """So many cameras are here."""
        ...

    def collected(self, sets: int, wanted: int) -> None:
        """So many complete sets have come."""
        ...

    def begun(self, sets: int, last: bool) -> None:
        """A calibration on so many sets begins; `last`: no more are waited for."""
        ...

    def tell(self, stage: str, share: float) -> None:
        """How far it is; on the thread that calibrates."""
        ...

    def show(self, estimate: Estimate, last: bool) -> None:
        """What it has found; `last`: with all sets of this round."""
        ...


class Coaches:
    """Several coaches who are told the same, in their order."""

    def __init__(self, *coaches: Coach) -> None:
        self._coaches = coaches

    def connected(self, cameras: int, expected: int | None) -> None:
        """So many cameras are here."""
        for coach in self._coaches:
            coach.connected(cameras, expected)

    def collected(self, sets: int, wanted: int) -> None:
        """So many complete sets have come."""
        for coach in self._coaches:
            coach.collected(sets, wanted)

    def begun(self, sets: int, last: bool) -> None:
        """A calibration on so many sets begins."""
        for coach in self._coaches:
            coach.begun(sets, last)

    def tell(self, stage: str, share: float) -> None:
        """How far it is."""
        for coach in self._coaches:
            coach.tell(stage, share)

    def show(self, estimate: Estimate, last: bool) -> None:
        """What it has found."""
        for coach in self._coaches:
            coach.show(estimate, last)


def coach_lines(estimate: Estimate) -> list[str]:
    """For a log: how many overlaps are good, those that are not, and by how much the target is missed."""
    lines = [headline(estimate.sets, estimate.pairs)]
    lines += [str(pair) for pair in estimate.pairs if pair.advice]
    return lines + ([f"target: {estimate.missed}"] if estimate.missed else [])


def headline(sets: int, pairs: Sequence[PairSupport]) -> str:
    """How the overlaps are, in one line."""
    good = sum(pair.support is Support.GOOD for pair in pairs)
    told = f"on {counted(sets, 'set')}: {good} of {counted(len(pairs), 'overlap')} good"
    known = [pair.expected for pair in pairs if pair.expected is not None]
    if not known:
        return told
    worst = Accuracy(max(one.deg for one in known), max(one.mm for one in known))
    return f"{told}, neighbours expected to be known to {worst} or better"


def counted(count: int, noun: str) -> str:
    """1 set, 2 sets."""
    return f"{count} {noun}" + "s" * (count != 1)
