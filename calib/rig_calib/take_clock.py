"""A take's times on other clocks: what its /clock messages say, interpolated."""

from bisect import bisect
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil, hypot
from statistics import median

from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import EncodedFrame
from rig_protocol.recording_format import ClockReading, DroppedFrames

# What a crystal wanders between two readings, and by how much it may be off beyond the last one: the same as
# in the estimate that the readings are of (protocol/SPEC.md, section 8).
_WANDER = 1e-6
_DRIFT = 100e-6
LATEST_NS = 2**62
"""The latest time that is taken for one: the year 2116 in UTC."""


@dataclass(frozen=True, slots=True)
class ClockMap:
    """Times of a take on another clock: the offset linear between readings, constant beyond them.

    `times_ns` ascending, with the offset and its standard uncertainty at each.
    """

    times_ns: Sequence[int] = (0,)
    offsets_ns: Sequence[int] = (0,)
    uncertainties_ns: Sequence[int] = (0,)
    exact: bool = False
    """Whether the clock is the take's own."""

    @property
    def typical_uncertainty_ns(self) -> int:
        """Median of the readings'."""
        return int(median(self.uncertainties_ns))

    def offset_at(self, time_ns: int) -> tuple[int, int]:
        """What to add to a time of the take, and the standard uncertainty of that."""
        if self.exact:
            return 0, 0
        right = bisect(self.times_ns, time_ns)
        if right == 0 or right == len(self.times_ns):
            nearest = min(right, len(self.times_ns) - 1)
            away_ns = abs(time_ns - self.times_ns[nearest])
            return self.offsets_ns[nearest], _with(self.uncertainties_ns[nearest], _DRIFT * away_ns)
        left = right - 1
        begin_ns, end_ns = self.times_ns[left], self.times_ns[right]
        change_ns = self.offsets_ns[right] - self.offsets_ns[left]
        offset_ns = self.offsets_ns[left] + change_ns * (time_ns - begin_ns) // (end_ns - begin_ns)
        away_ns = min(time_ns - begin_ns, end_ns - time_ns)
        known_ns = max(self.uncertainties_ns[left], self.uncertainties_ns[right])
        return offset_ns, _with(known_ns, _WANDER * away_ns)

    def frame(self, frame: EncodedFrame) -> EncodedFrame:
        """The same frame on the other clock; DataError where its time cannot be true."""
        offset_ns, uncertainty_ns = self.offset_at(frame.timestamp_ns)
        received_ns = frame.received_ns
        return replace(
            frame,
            timestamp_ns=_plausible(frame.timestamp_ns + offset_ns),
            uncertainty_ns=_with(frame.uncertainty_ns, uncertainty_ns),
            received_ns=None if received_ns is None else _plausible(received_ns + offset_ns),
        )

    def dropped(self, dropped: DroppedFrames) -> DroppedFrames:
        """The same on the other clock."""
        first_ns, last_ns = (one + self.offset_at(one)[0] for one in (dropped.first_ns, dropped.last_ns))
        return replace(dropped, first_ns=_plausible(first_ns), last_ns=_plausible(last_ns))


def clock_maps(own: str, readings: Iterable[ClockReading]) -> dict[str, ClockMap]:
    """The clocks on which a take's times are known, by name; `own` is the one that it was stamped by."""
    known: dict[str, dict[int, tuple[int, int]]] = {}
    for reading in readings:
        for tie in reading.ties:
            known.setdefault(tie.clock, {})[reading.time_ns] = (tie.offset_ns, tie.uncertainty_ns)
    maps = {clock: _map(told) for clock, told in known.items()}
    return maps | {own: ClockMap(exact=True)}


def common_clock(takes: Mapping[str, Mapping[str, ClockMap]]) -> str:
    """The clock on which the worst known of all takes is known best; ConfigurationError when there is none.

    `takes`: the clocks of each, by its name.
    """
    shared = sorted(set.intersection(*(set(clocks) for clocks in takes.values())))
    if not shared:
        told = "; ".join(f"{name} knows {_words(clocks)}" for name, clocks in takes.items())
        raise ConfigurationError(
            f"no clock is known to all takes ({told}): record while all agents hear one server, or let "
            "chrony run on every machine (docs/recording.md)"
        )
    return min(shared, key=lambda clock: max(c[clock].typical_uncertainty_ns for c in takes.values()))


def _words(clocks: Mapping[str, ClockMap]) -> str:
    return ", ".join(sorted(clock for clock, one in clocks.items() if not one.exact)) or "no other clock"


def _map(told: Mapping[int, tuple[int, int]]) -> ClockMap:
    times_ns = sorted(told)
    offsets_ns, uncertainties_ns = zip(*(told[time_ns] for time_ns in times_ns), strict=True)
    return ClockMap(times_ns, offsets_ns, uncertainties_ns)


def _with(uncertainty_ns: int, more_ns: float) -> int:
    return min(ceil(hypot(uncertainty_ns, more_ns)), LATEST_NS)


def _plausible(time_ns: int) -> int:
    if not 0 <= time_ns <= LATEST_NS:
        raise DataError(f"the clock of the take is out of reason: it leads to {time_ns} ns")
    return time_ns
