"""What a person can do to make this calibration better, the most useful first."""

from collections.abc import Mapping, Sequence

import numpy as np

from rig_calib.displacement import ROOM_DISTANCE_M, PairUncertainty, overlaps, worst_pair
from rig_calib.rig_calibration import CalibratedEdge, RigCalibration

_WEAK = 1.6  # times the median displacement: this overlap holds the rig back
_LOOP = 3  # cameras; fewer make none


def advice(
    calibration: RigCalibration, pairs: Sequence[PairUncertainty], names: Mapping[int, str]
) -> list[str]:
    """Sentences; none when nothing stands out."""
    told = [_unused(edge, pairs, names) for edge in overlaps(calibration) if not edge.used]
    weak = _weakest(calibration, pairs, names)
    told += [weak] if weak else []
    if calibration.loop_closure is None and len(calibration.cameras) >= _LOOP:
        told.append(
            "No loop of overlaps closes, so a false match would not show: once all neighbours around the "
            "ring are connected, the loop tells."
        )
    if calibration.cameras and not pairs:
        told.append(
            f"The method {calibration.method} states no uncertainty and corrects no depth: calibrate with "
            "--method joint for both. Until then the loop and the surfaces below say how good it is."
        )
    return told


def _unused(edge: CalibratedEdge, pairs: Sequence[PairUncertainty], names: Mapping[int, str]) -> str:
    held = next((pair for pair in pairs if {pair.i, pair.j} == {edge.i, edge.j}), None)
    told = f"{_title(edge, names)}: hang a pattern where both look, 0.8 to 3 m away"
    if held is None:
        return f"{told}; their overlap is not used."
    mm = held.displacement_mm(ROOM_DISTANCE_M)
    return f"{told}; only the other overlaps hold them together, to {mm:.0f} mm at {ROOM_DISTANCE_M:g} m."


def _weakest(
    calibration: RigCalibration, pairs: Sequence[PairUncertainty], names: Mapping[int, str]
) -> str | None:
    """About the used overlap that is known least, where it is much worse than the others."""
    used = {frozenset((edge.i, edge.j)): edge for edge in calibration.edges if edge.used}
    measured = [pair for pair in pairs if frozenset((pair.i, pair.j)) in used]
    worst = worst_pair(measured, ROOM_DISTANCE_M)
    if worst is None or len(measured) < 2:
        return None
    mm, typical = worst.displacement_mm(ROOM_DISTANCE_M), _typical_mm(measured)
    if mm < _WEAK * typical:
        return None
    edge = used[frozenset((worst.i, worst.j))]
    return (
        f"{_title(edge, names)}: {edge.inliers} matches leave {mm:.0f} mm at {ROOM_DISTANCE_M:g} m, "
        f"a typical overlap {typical:.0f} mm: put more texture there, spread over the height of the overlap."
    )


def _title(edge: CalibratedEdge, names: Mapping[int, str]) -> str:
    return f"{names.get(edge.i, edge.i)} – {names.get(edge.j, edge.j)}"


def _typical_mm(pairs: Sequence[PairUncertainty]) -> float:
    return float(np.median([pair.displacement_mm(ROOM_DISTANCE_M) for pair in pairs]))
