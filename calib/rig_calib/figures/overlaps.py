"""One card for every overlap: its matches, its residuals, and a cut through what both cameras see there."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from rig_calib.displacement import ROOM_DISTANCE_M, PairUncertainty, least_certain, pair_frame
from rig_calib.evidence import EdgeEvidence
from rig_calib.figures import charts, pictures
from rig_calib.figures.case import ReportCase, Stage
from rig_calib.figures.page import Figure
from rig_calib.overlap import Region
from rig_calib.projection import inside, project
from rig_calib.rig_calibration import CalibratedEdge
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import Pose, inverse, transform_points

Array = npt.NDArray[np.float64]

_MAX_CARDS = 24  # 100 kB each; more edges than this are in the table only
_MATCH_MARGIN_PX = 10
_CUT_M = 0.5  # side of the square that a cut shows
_CUT_STYLE = pictures.SliceStyle(size_px=300, pen_px=2, half_height_m=0.1)
_STRIDE = 5  # points looked at
_MIN_COMMON_POINTS = 30


@dataclass(frozen=True, slots=True)
class OverlapCard:
    """What the page shows of one pair; `status` is `worst`, `unused` or empty."""

    title: str
    status: str
    facts: str
    reason: str
    matches: Figure
    charts: Sequence[Markup]
    cuts: Sequence[Figure]


def overlap_cards(case: ReportCase) -> list[OverlapCard]:
    """A card for each edge with matches; of too many, for the least certain and those with most inliers."""
    first: dict[tuple[int, int], EdgeEvidence] = {}
    for item in case.evidence:
        first.setdefault((item.i, item.j), item)
    worst = least_certain(case.pairs)
    shown = sorted(first.values(), key=lambda item: (not _is_of(worst, item), -item.inlier.sum()))[
        :_MAX_CARDS
    ]
    return [_card(item, case) for item in sorted(shown, key=lambda item: (item.i, item.j))]


def _card(item: EdgeEvidence, case: ReportCase) -> OverlapCard:
    edge = next((edge for edge in case.calibration.edges if {edge.i, edge.j} == {item.i, item.j}), None)
    names = case.names
    title = f"{names[item.i]} – {names[item.j]}"
    is_worst = _is_of(least_certain(case.pairs), item)
    unused = edge is not None and not edge.used
    return OverlapCard(
        title=title,
        status="worst" if is_worst else "unused" if unused else "",
        facts=_facts(item, case),
        reason=(edge.reason or "") if edge else "",
        matches=_match_figure(item, title, case),
        charts=_histograms(item),
        cuts=_cut_figures(item, edge, title, case),
    )


def _is_of(pair: PairUncertainty | None, item: EdgeEvidence) -> bool:
    return pair is not None and {pair.i, pair.j} == {item.i, item.j}


def _facts(item: EdgeEvidence, case: ReportCase) -> str:
    facts = [f"{np.count_nonzero(item.inlier)} of {len(item.inlier)} matches kept"]
    pair = case.pair(item.i, item.j)
    if pair is not None:
        deg, mm = pair.sigma
        facts.append(f"σ {deg:.2f}° / {mm:.1f} mm")
        facts.append(f"{pair.displacement_mm(ROOM_DISTANCE_M):.1f} mm at {ROOM_DISTANCE_M:g} m")
        facts.append(f"weakest: {pair.weakest_motion(ROOM_DISTANCE_M)}")
    return " · ".join(facts)


def _match_figure(item: EdgeEvidence, title: str, case: ReportCase) -> Figure:
    portrait = case.viewpoint is not None and case.viewpoint.portrait
    images = (case.view(item.i).color[item.frame], case.view(item.j).color[item.frame])
    picture = pictures.match_picture(
        item, images, _regions(item, case), portrait, i_is_left=case.is_left(item.i, item.j)
    )
    return Figure.photo(picture, f"Matches of {title}")


def _regions(item: EdgeEvidence, case: ReportCase) -> tuple[Region, Region]:
    """The parts of both images that hold what the other sees, and the matches."""
    return _region(item.i, item.j, item.pixels_i, item.inlier, case), _region(
        item.j, item.i, item.pixels_j, item.inlier, case
    )


def _region(of: int, by: int, pixels: Array, inlier: npt.NDArray[np.bool_], case: ReportCase) -> Region:
    color = case.intrinsics[of]
    shown = [pixels[inlier] if inlier.any() else pixels]
    after = case.stage("after")
    if after is not None and (common := _common_points(of, by, after, case.intrinsics)) is not None:
        low, high = np.percentile(project(color, common), (1, 99), axis=0)
        shown += [low[None], high[None]]
    corners = np.concatenate(shown)
    low = np.maximum(corners.min(axis=0) - _MATCH_MARGIN_PX, 0)
    high = np.minimum(corners.max(axis=0) + _MATCH_MARGIN_PX, (color.width, color.height))
    return Region(int(low[0]), int(low[1]), int(high[0]), int(high[1]))


def _histograms(item: EdgeEvidence) -> list[Markup]:
    named = {"pixels": item.pixel_errors, "disparity": item.disparity_errors}
    return [
        Markup(charts.normal_histogram(values, name))  # noqa: S704  # charts escape every text
        for name, values in named.items()
        if len(values)
    ]


def _cut_figures(
    item: EdgeEvidence, edge: CalibratedEdge | None, title: str, case: ReportCase
) -> list[Figure]:
    """The same half metre of the room from above, before and after, the two cameras in two colours."""
    after = case.stage("after")
    if after is None or edge is None or case.viewpoint is None or not {item.i, item.j} <= after.poses.keys():
        return []
    T_view_rig = inverse(case.viewpoint.T_rig_view)
    T_rig_pair = case.viewpoint.T_rig_view @ pair_frame(
        T_view_rig @ after.poses[item.i], T_view_rig @ after.poses[item.j]
    )
    centre = _common_place(item, after, T_rig_pair, case.intrinsics)
    if centre is None:
        return []
    limits = np.stack([centre - _CUT_M / 2, centre + _CUT_M / 2])
    figures = (_cut_figure(item, stage, after, T_rig_pair, limits, title) for stage in case.stages)
    return [figure for figure in figures if figure is not None]


def _cut_figure(
    item: EdgeEvidence, stage: Stage, after: Stage, T_rig_pair: Pose, limits: Array, title: str
) -> Figure | None:
    surfaces = [stage.surface(item.i), stage.surface(item.j)]
    if None in surfaces or not {item.i, item.j} <= stage.poses.keys():
        return None
    here = [surface for surface in surfaces if surface is not None]
    # Camera i stays in place: the pair is looked at, not what the rest of the rig did to it.
    poses = {
        item.i: after.poses[item.i],
        item.j: after.poses[item.i] @ inverse(stage.poses[item.i]) @ stage.poses[item.j],
    }
    picture = pictures.slice_picture(here, poses, T_rig_pair, limits, pictures.PAIR_COLORS, _CUT_STYLE)
    difference = stage.differences_mm.get((min(item.i, item.j), max(item.i, item.j)))
    caption = stage.name if difference is None else f"{stage.name}: {difference:.1f} mm"
    return Figure.drawing(picture, f"Cut through the overlap of {title}, {stage.name}", caption)


def _common_place(
    item: EdgeEvidence, stage: Stage, T_rig_pair: Pose, intrinsics: Mapping[int, Intrinsics]
) -> Array | None:
    """Where on the cut (2,), x and y of the pair's frame, a surface of camera i lies that j sees, too."""
    common = _common_points(item.i, item.j, stage, intrinsics)
    if common is None:
        return None
    places = transform_points(inverse(T_rig_pair) @ stage.poses[item.i], common)
    places = places[np.abs(places[:, 2]) < _CUT_STYLE.half_height_m, :2]
    if len(places) < _MIN_COMMON_POINTS:
        return None
    middle = np.median(places, axis=0)
    return np.asarray(places[np.argmin(np.linalg.norm(places - middle, axis=1))])


def _common_points(of: int, by: int, stage: Stage, intrinsics: Mapping[int, Intrinsics]) -> Array | None:
    """Points (N,3) of a camera's surface, in its frame, that lie in the other's field; None of few."""
    surface = stage.surface(of)
    if surface is None or by not in stage.poses:
        return None
    points = surface.points_m[::_STRIDE].astype(np.float64)
    seen = transform_points(inverse(stage.poses[by]) @ stage.poses[of], points)
    common = seen[:, 2] > 0.1
    common[common] = inside(intrinsics[by], project(intrinsics[by], seen[common]))
    return points[common] if common.sum() >= _MIN_COMMON_POINTS else None
