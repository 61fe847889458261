"""What a person can do to make this calibration better, the most useful first."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from rig_calib.displacement import ROOM_DISTANCE_M, PairUncertainty, least_certain, overlaps
from rig_calib.rig_calibration import CalibratedEdge, RigCalibration

_WEAK = 1.6  # times the median displacement: this overlap holds the rig back
_LOOP = 3  # cameras; fewer make none


def advice(
    calibration: RigCalibration, pairs: Sequence[PairUncertainty], names: Mapping[int, str]
) -> list[str]:
    """Sentences; none when nothing stands out."""
    measured = _measured(calibration, pairs)
    told = [
        _unused(edge, pairs, names) for edge in overlaps(calibration) if _is_missed(edge, pairs, measured)
    ]
    weak = _weakest(measured, names)
    told += [weak] if weak else []
    if calibration.loop_closure is None and len(calibration.cameras) >= _LOOP:
        told.append(
            "No loop of overlaps closes, so a false match would not show: once all neighbours around the "
            "ring are connected, the loop tells."
        )
    if calibration.method == "paper":
        told.append(
            "The method paper states no uncertainty and corrects no depth, whose usual bias of a percent "
            "leaves about 0.4° and 20 mm in each overlap: calibrate with --method joint for both."
        )
    return told


def _measured(
    calibration: RigCalibration, pairs: Sequence[PairUncertainty]
) -> dict[PairUncertainty, CalibratedEdge]:
    """The overlaps that were used, with their edges."""
    used = {frozenset((edge.i, edge.j)): edge for edge in calibration.edges if edge.used}
    ends = {pair: frozenset((pair.i, pair.j)) for pair in pairs}
    return {pair: used[both] for pair, both in ends.items() if both in used}


def _is_missed(
    edge: CalibratedEdge, pairs: Sequence[PairUncertainty], measured: Collection[PairUncertainty]
) -> bool:
    """Whether an overlap was not used and the others do not make up for it."""
    held = next((pair for pair in pairs if {pair.i, pair.j} == {edge.i, edge.j}), None)
    if edge.used or held is None or not measured:
        return not edge.used
    return held.displacement_mm(ROOM_DISTANCE_M) >= _WEAK * _typical_mm(measured)


def _unused(edge: CalibratedEdge, pairs: Sequence[PairUncertainty], names: Mapping[int, str]) -> str:
    held = next((pair for pair in pairs if {pair.i, pair.j} == {edge.i, edge.j}), None)
    told = f"{_title(edge, names)}: hang a pattern where both look, 0.8 to 3 m away"
    if held is None:
        return f"{told}; their overlap is not used."
    mm = held.displacement_mm(ROOM_DISTANCE_M)
    return f"{told}; only the other overlaps hold them together, to {mm:.0f} mm at {ROOM_DISTANCE_M:g} m."


def _weakest(measured: Mapping[PairUncertainty, CalibratedEdge], names: Mapping[int, str]) -> str | None:
    """About the used overlap that is known least, where it is much worse than the others."""
    worst = least_certain(list(measured))
    if worst is None:
        return None
    mm, typical = worst.displacement_mm(ROOM_DISTANCE_M), _typical_mm(measured)
    if mm < _WEAK * typical:
        return None
    edge = measured[worst]
    return (
        f"{_title(edge, names)}: {edge.inliers} matches leave {mm:.0f} mm at {ROOM_DISTANCE_M:g} m, "
        f"a typical overlap {typical:.0f} mm: put more texture there, spread over the height of the overlap."
    )


def _title(edge: CalibratedEdge, names: Mapping[int, str]) -> str:
    return f"{names.get(edge.i, edge.i)} – {names.get(edge.j, edge.j)}"


def _typical_mm(pairs: Collection[PairUncertainty]) -> float:
    return float(np.median([pair.displacement_mm(ROOM_DISTANCE_M) for pair in pairs]))
