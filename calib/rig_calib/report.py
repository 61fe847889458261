"""report.html: one self-contained page that shows whether a calibration can be trusted, and why."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import jinja2
import numpy as np
from markupsafe import Markup

from rig_calib.evidence import EdgeEvidence
from rig_calib.figures import charts, pictures, tables
from rig_calib.figures.dollhouse import BACK_AZIMUTH_DEG, FRONT_AZIMUTH_DEG, dollhouse_picture, share_facing
from rig_calib.figures.plan_view import PlanView, plan_view
from rig_calib.fusion.agreement import overlap_differences_m
from rig_calib.fusion.fused import FusedRig
from rig_calib.fusion.panorama_picture import panorama_picture
from rig_calib.fusion.surface import Surface
from rig_calib.fusion.viewpoint import Viewpoint, rig_viewpoint
from rig_calib.rig_calibration import RigCalibration
from rig_calib.view import CameraView
from rig_calib.whole_file import whole_file
from rig_protocol.camera import Intrinsics
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose, inverse

_MAX_MATCH_PICTURES = 24  # 60 kB each; more edges than this are in the table only
_PANORAMA_PX = 2200  # width of the panorama in the page
_RESIDUAL_LIMIT_PX = 5.0
_MIN_SHARE_SEEN = 0.25  # of the cloud, for a picture from that side to be worth its place
_MIN_LOOP_POINTS = 1000  # below, a cut through the room shows nothing


@dataclass(frozen=True, slots=True)
class Figure:
    """An embedded image with its caption, and its description for those who cannot see it."""

    data_uri: str
    alt: str
    caption: str = ""


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
    viewpoint = rig_viewpoint(calibration.poses, calibration.rig_frame) if calibration.cameras else None
    case = _Case(calibration, views, evidence, poses_before, fused, viewpoint)
    names = {view.camera_id: view.name for view in views}
    return _template().render(
        calibration=calibration,
        verdict=tables.verdict(calibration, len(views)),
        key_figures=tables.key_figures(calibration, len(views)) | _agreement(case),
        skipped=fused.cloud.skipped if fused else (),
        panorama=_panorama(fused),
        clouds=_clouds(case),
        loop_pictures=_loop_pictures(case),
        plan=_plan(case),
        cameras=tables.camera_rows(calibration, views, viewpoint),
        edges=tables.edge_rows(calibration, names, evidence),
        histogram=_histogram(evidence, "all edges"),
        edge_histograms=_edge_histograms(evidence, names),
        matches=_match_figures(case),
        timing=_timing(calibration.seconds),
        provenance=tables.flatten(calibration.provenance),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """All that one report is about."""

    calibration: RigCalibration
    views: Sequence[CameraView]
    evidence: Sequence[EdgeEvidence]
    poses_before: Mapping[int, Pose] | None
    fused: FusedRig | None
    viewpoint: Viewpoint | None

    def surfaces_at(self, poses: Mapping[int, Pose]) -> list[Surface]:
        """The surfaces whose cameras have a pose."""
        return [s for s in (self.fused.surfaces if self.fused else ()) if s.camera_id in poses]

    def intrinsics(self) -> dict[int, Intrinsics]:
        """Of the colour cameras by camera id."""
        return {view.camera_id: view.model.color for view in self.views}


def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rig_calib", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html")


def _figure(image: ImageU8, alt: str, caption: str = "", drawing: bool = False) -> Figure:
    kind, data = ("png", pictures.encode_png(image)) if drawing else ("jpeg", pictures.encode_jpeg(image))
    return Figure(f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}", alt, caption)


def _panorama(fused: FusedRig | None) -> Figure | None:
    if fused is None or fused.panorama is None:
        return None
    picture = panorama_picture(fused.panorama)
    scale = min(1.0, _PANORAMA_PX / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return _figure(
        np.asarray(small, dtype=np.uint8),
        "Panorama of the rig's surroundings: colour above, distance from the axis below",
        "Colour and distance from the rig's axis, all cameras blended. A name stands where its camera looks.",
    )


def _clouds(case: _Case) -> list[Figure]:
    if case.fused is None or case.viewpoint is None or not len(case.fused.cloud):
        return []
    cloud, T_rig_view = case.fused.cloud, case.viewpoint.T_rig_view
    sides = {"the back": BACK_AZIMUTH_DEG, "the front": FRONT_AZIMUTH_DEG}
    caption = "From above {} of the rig; {:,} points. Surfaces that face away are left out."
    return [
        _figure(
            dollhouse_picture(cloud, T_rig_view, azimuth),
            f"Fused point cloud seen from above {name}",
            caption.format(name, len(cloud)),
        )
        for name, azimuth in sides.items()
        if share_facing(cloud, T_rig_view, azimuth) > _MIN_SHARE_SEEN
    ]


def _loop_pictures(case: _Case) -> list[Figure]:
    if case.viewpoint is None or case.fused is None or len(case.fused.cloud) < _MIN_LOOP_POINTS:
        return []
    T_rig_view, poses = case.viewpoint.T_rig_view, case.calibration.poses
    limits = pictures.view_limits(case.surfaces_at(poses), poses, T_rig_view)
    stages = {"after loop closure": poses}
    if case.poses_before:
        stages = {"before loop closure": _anchored(case.poses_before, poses), **stages}
    found = []
    for name, stage_poses in stages.items():
        surfaces = case.surfaces_at(stage_poses)
        picture = pictures.slice_picture(surfaces, stage_poses, T_rig_view, limits)
        alt = f"Walls at camera height from above, {name}, one colour a camera"
        found.append(_figure(picture, alt, name.capitalize(), drawing=True))
    return found


def _anchored(before: Mapping[int, Pose], after: Mapping[int, Pose]) -> dict[int, Pose]:
    """Poses before loop closure in the frame of those after it: their first common camera stays in place."""
    common = sorted(before.keys() & after.keys())
    if not common:
        return dict(before)
    T_after_before = after[common[0]] @ inverse(before[common[0]])
    return {camera_id: T_after_before @ T for camera_id, T in before.items()}


def _plan(case: _Case) -> PlanView | None:
    intrinsics = case.intrinsics()
    if case.viewpoint is None or not case.calibration.poses.keys() <= intrinsics.keys():
        return None
    return plan_view(case.calibration, intrinsics, case.viewpoint.T_rig_view)


def _agreement(case: _Case) -> dict[str, str]:
    """By how much surfaces of neighbours differ where they overlap, as a key figure."""
    texts = []
    for poses in filter(None, (case.poses_before, case.calibration.poses)):
        differences = overlap_differences_m(case.surfaces_at(poses), case.intrinsics(), poses)
        if differences:
            texts.append(f"{1e3 * np.median(list(differences.values())):.1f}")
    return {"overlaps differ by": " → ".join(texts) + " mm"} if texts else {}


def _histogram(evidence: Sequence[EdgeEvidence], title: str, width: int = 460) -> Markup | None:
    kept, rejected = tables.kept_residuals(evidence), tables.rejected_residuals(evidence)
    if not len(kept) + len(rejected):
        return None
    chart = charts.histogram(kept, rejected, _RESIDUAL_LIMIT_PX, "px", title, width=width)
    return Markup(chart)  # noqa: S704  # charts escape every text they are given


def _edge_histograms(evidence: Sequence[EdgeEvidence], names: Mapping[int, str]) -> list[Markup]:
    shown = list(_by_pair(evidence).items())[:_MAX_MATCH_PICTURES]
    charts_of_edges = (
        _histogram(items, f"{names.get(i, i)} – {names.get(j, j)}", width=300) for (i, j), items in shown
    )
    return [chart for chart in charts_of_edges if chart is not None]


def _match_figures(case: _Case) -> list[Figure]:
    """A picture for each edge; where there are too many, for those with most inliers."""
    pairs = sorted(_by_pair(case.evidence).values(), key=lambda items: -items[0].inlier.sum())
    shown = sorted((items[0] for items in pairs[:_MAX_MATCH_PICTURES]), key=lambda item: (item.i, item.j))
    return [_match_figure(item, case) for item in shown]


def _match_figure(item: EdgeEvidence, case: _Case) -> Figure:
    by_id = {view.camera_id: view for view in case.views}
    view_i, view_j = by_id[item.i], by_id[item.j]
    portrait = case.viewpoint is not None and case.viewpoint.portrait
    images = view_i.color[item.frame], view_j.color[item.frame]
    picture = pictures.match_picture(item, *images, portrait, i_is_left=_is_left(item, case))
    pair = f"{view_i.name} – {view_j.name}"
    caption = f"{pair}: {np.count_nonzero(item.inlier)} of {len(item.inlier)} matches kept"
    return _figure(picture, f"Matches of {pair}", caption)


def _by_pair(evidence: Sequence[EdgeEvidence]) -> dict[tuple[int, int], list[EdgeEvidence]]:
    pairs: dict[tuple[int, int], list[EdgeEvidence]] = {}
    for item in evidence:
        pairs.setdefault((item.i, item.j), []).append(item)
    return pairs


def _is_left(item: EdgeEvidence, case: _Case) -> bool:
    """Does camera i look to the left of camera j?"""
    poses = case.calibration.poses
    if case.viewpoint is None or not {item.i, item.j} <= poses.keys():
        return True
    axis_i, axis_j = poses[item.i][:3, 2], poses[item.j][:3, 2]
    return bool(np.cross(axis_j, axis_i) @ case.viewpoint.T_rig_view[:3, 2] > 0)


def _timing(seconds: Mapping[str, float]) -> Markup | None:
    stages = {name: value for name, value in seconds.items() if name != "total"}
    if not stages:
        return None
    return Markup(charts.horizontal_bars(stages, "s", "Seconds spent in each stage"))  # noqa: S704  # escaped
