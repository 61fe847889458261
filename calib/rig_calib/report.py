"""report.html: one self-contained page that shows whether a calibration can be trusted, and why."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2
import numpy as np
from markupsafe import Markup

from rig_calib.displacement import ROOM_DISTANCE_M, PairUncertainty, least_certain, least_certain_of
from rig_calib.evidence import EdgeEvidence
from rig_calib.figures import charts, rooms, tables
from rig_calib.figures.advice import advice
from rig_calib.figures.bias_maps import MAP_DISTANCE_M, bias_maps
from rig_calib.figures.case import ReportCase
from rig_calib.figures.overlaps import overlap_cards
from rig_calib.figures.plan_view import PlanView, plan_view
from rig_calib.fusion.fused import FusedRig
from rig_calib.rig_calibration import RigCalibration
from rig_calib.view import CameraView
from rig_calib.whole_file import whole_file
from rig_protocol.poses import Pose

_RESIDUAL_LIMIT_PX = 5.0
_MAX_PAIRS_SHOWN = 16  # in plan and chart; where all cameras see each other there are many more


def write_report(
    path: Path,
    calibration: RigCalibration,
    views: Sequence[CameraView],
    evidence: Sequence[EdgeEvidence] = (),
    poses_before: Mapping[int, Pose] | None = None,
    fused: FusedRig | None = None,
) -> None:
    """Write the page, the file whole or not at all.

    `views` are those of the capture, placed or not; `poses_before` are those before loop closure, in
    any frame; without `fused` the page has no panorama and no clouds.
    """
    html = report_html(calibration, views, evidence, poses_before, fused)
    with whole_file(path) as file:
        file.write(html.encode())


def report_html(
    calibration: RigCalibration,
    views: Sequence[CameraView],
    evidence: Sequence[EdgeEvidence] = (),
    poses_before: Mapping[int, Pose] | None = None,
    fused: FusedRig | None = None,
) -> str:
    """The page as text; see `write_report`."""
    case = ReportCase.of(calibration, views, evidence, poses_before, fused)
    maps, bias_limit_mm = bias_maps(case)
    return _template().render(
        calibration=calibration,
        verdict=tables.verdict(calibration, len(views)),
        key_figures=tables.key_figures(calibration, len(views)) | _more_key_figures(case),
        advice=advice(calibration, case.pairs, case.names),
        skipped=fused.cloud.skipped if fused else (),
        plan=_plan(case),
        displacement_chart=_displacement_chart(case),
        displacements=tables.displacement_rows(calibration, case.pairs, case.stages),
        distances_m=tables.DISTANCES_M,
        pairs_shown=len(_shown(case.pairs)),
        room_distance_m=ROOM_DISTANCE_M,
        clouds=rooms.clouds(case),
        cuts=rooms.cuts(case),
        panorama=rooms.panorama(fused),
        overlaps=overlap_cards(case),
        cameras=tables.camera_rows(calibration, views, case.viewpoint),
        edges=tables.edge_rows(calibration, case.names, evidence),
        residuals=_residual_charts(evidence),
        bias_maps=maps,
        bias_limit_mm=bias_limit_mm,
        bias_distance_m=MAP_DISTANCE_M,
        timing=_timing(calibration.seconds),
        provenance=tables.flatten(calibration.provenance),
    )


def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rig_calib", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html")


def _more_key_figures(case: ReportCase) -> dict[str, str]:
    figures = {}
    if case.pairs:
        mm = [pair.displacement_mm(ROOM_DISTANCE_M) for pair in case.pairs]
        figures[f"overlaps at {ROOM_DISTANCE_M:g} m"] = f"{np.median(mm):.1f} mm, worst {max(mm):.1f}"
    differ = rooms.differ(case.stages)
    return figures | ({"surfaces differ by": differ} if differ else {})


def _plan(case: ReportCase) -> PlanView | None:
    if case.viewpoint is None or not case.calibration.poses.keys() <= case.intrinsics.keys():
        return None
    return plan_view(case.calibration, case.intrinsics, case.viewpoint.T_rig_view, _shown(case.pairs))


def _displacement_chart(case: ReportCase) -> Markup | None:
    if not case.pairs:
        return None
    names = {camera.id: camera.name for camera in case.calibration.cameras}
    groups = {
        (names[pair.i], names[pair.j]): [pair.displacement_mm(d) for d in tables.DISTANCES_M]
        for pair in _shown(case.pairs)
    }
    series = [f"{distance:g} m" for distance in tables.DISTANCES_M]
    told = "Displacement between the cameras of each overlap, by distance"
    worst = least_certain(case.pairs)
    highlight = None if worst is None else (names[worst.i], names[worst.j])
    return _markup(charts.grouped_bars(groups, series, "mm", told, highlight))


def _shown(pairs: Sequence[PairUncertainty]) -> list[PairUncertainty]:
    return least_certain_of(pairs, _MAX_PAIRS_SHOWN)


def _residual_charts(evidence: Sequence[EdgeEvidence]) -> list[Markup]:
    """Standardised residuals of all overlaps, and what was kept and rejected in pixels."""
    found = []
    for name in ("pixel", "disparity"):
        values = np.concatenate([np.empty(0), *(getattr(item, f"{name}_errors") for item in evidence)])
        if len(values):
            found.append(
                _markup(charts.normal_histogram(values, f"{name}, all overlaps", width=360, height=200))
            )
    kept, rejected = tables.kept_residuals(evidence), tables.rejected_residuals(evidence)
    if len(kept) + len(rejected):
        title = "reprojection, kept and rejected"
        chart = charts.histogram(kept, rejected, _RESIDUAL_LIMIT_PX, "px", title, width=360)
        found.append(_markup(chart))
    return found


def _timing(seconds: Mapping[str, float]) -> Markup | None:
    stages = {name: value for name, value in seconds.items() if name != "total"}
    if not stages:
        return None
    return _markup(charts.horizontal_bars(stages, "s", "Seconds spent in each stage"))


def _markup(chart: str) -> Markup:
    return Markup(chart)  # noqa: S704  # charts escape every text they are given
