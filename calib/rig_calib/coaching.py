"""The coach: how well every overlap of a rig is supported so far, and what to do where it is not."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from rig_calib.accuracy import Accuracy, AccuracyTarget
from rig_calib.overlap import Region, shared_regions, whole_image
from rig_calib.overlap_survey import obstacle
from rig_calib.rig_calibration import CalibratedEdge, RigCalibration
from rig_calib.view import CameraView

Pair = tuple[int, int]

# Three times what one frame of a well textured room gives: an overlap worse than that could be better.
ORDINARY = Accuracy(deg=0.3, mm=10.0)
_PATTERN = "hang a pattern where both look, 0.8 to 3 m away"
_SPREAD = "spread patterns over the whole height of the overlap"


class Support(StrEnum):
    """How well an overlap is supported."""

    GOOD = "good"
    WEAK = "weak"
    NOTHING = "nothing"


@dataclass(frozen=True, slots=True)
class PairSupport:
    """Two neighbours: the matches that agree, the expected error of their relative pose, what to do.

    `expected` is None while one of them has no pose, and where the method gives no covariance. `advice` is
    None for an overlap that needs nothing.
    """

    i: int
    j: int
    name: str
    matches: int
    used: bool
    expected: Accuracy | None
    support: Support
    advice: str | None = None

    def __str__(self) -> str:
        """For people: "overlap cam03–cam04: 6 matches, ±12 mm: hang a pattern ..."."""
        parts = [f"{self.matches} match" + "es" * (self.matches != 1)]
        if self.expected is not None:
            mm = self.expected.mm
            parts.append(f"±{self.expected.deg:.2f}° ±{mm:.{int(mm < 10.0)}f} mm")
        return f"overlap {self.name}: {', '.join(parts)}" + (f": {self.advice}" if self.advice else "")


def pair_supports(
    calibration: RigCalibration,
    views: Sequence[CameraView],
    target: AccuracyTarget | None = None,
    of_camera: int | None = None,
) -> tuple[PairSupport, ...]:
    """Every overlap of the rig, or of one camera, by a calibration on the frames so far.

    Overlaps are those of the drawing; without one the used edges, and the best of a camera that has none.
    DataError when images do not fit their camera's model.
    """
    by_id = {view.camera_id: view for view in views}
    edges = {_ordered(edge): edge for edge in calibration.edges}
    drawn = _drawn_overlaps(views)
    pairs = drawn.keys() | _supported(edges.values(), by_id, drawn)
    limit = ORDINARY if target is None else target.limit
    return tuple(
        _support(calibration, by_id, pair, edges.get(pair), drawn.get(pair), limit)
        for pair in sorted(pairs)
        if pair[0] in by_id and pair[1] in by_id and (of_camera is None or of_camera in pair)
    )


def shortfall(pairs: Iterable[PairSupport], target: AccuracyTarget) -> str | None:
    """By how much the pairs with a used edge miss the target, and which limits; None when all meet it."""
    return target.shortfall((pair.name, pair.expected) for pair in pairs if pair.used)


def _ordered(edge: CalibratedEdge) -> Pair:
    return min(edge.i, edge.j), max(edge.i, edge.j)


def _drawn_overlaps(views: Sequence[CameraView]) -> dict[Pair, tuple[Region, Region]]:
    """Where the drawing says that two cameras share a view, without any margin."""
    drawn = [view for view in views if view.T_rig_nominal is not None]
    return shared_regions(
        {view.camera_id: view.model.color for view in drawn},
        {view.camera_id: view.T_rig_nominal for view in drawn},
        margin_deg=0.0,
    )


def _supported(
    edges: Iterable[CalibratedEdge], views: Mapping[int, CameraView], drawn: Iterable[Pair]
) -> set[Pair]:
    """Pairs of used edges, and the best pair of a camera that has neither such a one nor a drawn overlap."""
    listed = sorted(edges, key=lambda edge: (edge.inliers, edge.matches))
    pairs = {_ordered(edge) for edge in listed if edge.used}
    lonely = views.keys() - {camera for pair in (*pairs, *drawn) for camera in pair}
    best = {camera: _ordered(edge) for edge in listed for camera in (edge.i, edge.j) if camera in lonely}
    return pairs | set(best.values())


def _support(
    calibration: RigCalibration,
    views: Mapping[int, CameraView],
    pair: Pair,
    edge: CalibratedEdge | None,
    regions: tuple[Region, Region] | None,
    limit: Accuracy,
) -> PairSupport:
    covariance = calibration.relative_covariance(*pair)
    expected = None if covariance is None else Accuracy.of(covariance)
    used = edge is not None and edge.used
    support = _state(edge, expected, limit)
    name = f"{views[pair[0]].name}–{views[pair[1]].name}"
    advice = None
    if support is not Support.GOOD:
        sides = regions or tuple(whole_image(views[camera].model.color) for camera in pair)
        found = obstacle(views, dict(zip(pair, sides, strict=True)))
        advice = found or (_PATTERN if support is Support.NOTHING else _more(edge))
    return PairSupport(*pair, name, edge.inliers if edge else 0, used, expected, support, advice)


def _state(edge: CalibratedEdge | None, expected: Accuracy | None, limit: Accuracy) -> Support:
    """A used edge is good or weak; one that is not used is weak when its matches at least agree on a pose."""
    if edge is None or not (edge.used or edge.rms_mm > 0.0):
        return Support.NOTHING
    if edge.used and (expected is None or expected.within(limit)):
        return Support.GOOD
    return Support.WEAK


def _more(edge: CalibratedEdge | None) -> str:
    """What to do with matches that agree and still do not suffice."""
    if edge is None or edge.reason is None:
        return f"{_SPREAD}, or give it more frames"
    return f"{edge.reason}; {_SPREAD}"
