"""The room as the calibration puts it together: panorama, clouds and cuts, before and after."""

from collections.abc import Sequence

import cv2
import numpy as np

from rig_calib.figures import pictures
from rig_calib.figures.case import ReportCase, Stage
from rig_calib.figures.dollhouse import BACK_AZIMUTH_DEG, FRONT_AZIMUTH_DEG, dollhouse_picture, share_facing
from rig_calib.figures.page import Figure
from rig_calib.fusion.cloud import PointCloud
from rig_calib.fusion.fused import FusedRig
from rig_calib.fusion.panorama_picture import panorama_picture
from rig_calib.fusion.point_cloud import fuse_surfaces
from rig_protocol.poses import Pose

_PANORAMA_PX = 2200  # width of the panorama in the page
_MIN_SHARE_SEEN = 0.25  # of the cloud, for a picture from that side to be worth its place
_MIN_CUT_POINTS = 1000  # below, a cut through the room shows nothing
_STAGES = {
    "before": "Before: pairs chained without closing the loop, depth as measured",
    "after": "After: adjusted, depth corrected",
}


def panorama(fused: FusedRig | None) -> Figure | None:
    """Colour and distance all around."""
    if fused is None or fused.panorama is None:
        return None
    picture = panorama_picture(fused.panorama)
    scale = min(1.0, _PANORAMA_PX / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return Figure.photo(
        np.asarray(small, dtype=np.uint8),
        "Panorama of the rig's surroundings: colour above, distance from the axis below",
        "Colour and distance from the rig's axis, all cameras blended. A name stands where its camera looks.",
    )


def clouds(case: ReportCase) -> list[Figure]:
    """The cloud from its back and its front, before and after, each pair from the same place."""
    if case.fused is None or case.viewpoint is None or not len(case.fused.cloud):
        return []
    after, T_rig_view = case.fused.cloud, case.viewpoint.T_rig_view
    known = {stage.name: _cloud(stage, case.fused) for stage in case.stages}
    sides = {"the back": BACK_AZIMUTH_DEG, "the front": FRONT_AZIMUTH_DEG}
    return [
        Figure.photo(
            dollhouse_picture(cloud, T_rig_view, azimuth, framed_by=after),
            f"Fused point cloud seen from above {side}, {stage}",
            f"{_STAGES[stage]}; from above {side} of the rig, {len(cloud):,} points.",
        )
        for side, azimuth in sides.items()
        if share_facing(after, T_rig_view, azimuth) > _MIN_SHARE_SEEN
        for stage, cloud in known.items()
    ]


def cuts(case: ReportCase) -> list[Figure]:
    """Walls at camera height from above, before and after, one colour a camera."""
    if case.viewpoint is None or case.fused is None or len(case.fused.cloud) < _MIN_CUT_POINTS:
        return []
    T_rig_view: Pose = case.viewpoint.T_rig_view
    limits = pictures.view_limits(case.fused.surfaces, case.calibration.poses, T_rig_view)
    return [_cut(stage, T_rig_view, limits) for stage in case.stages]


def _cloud(stage: Stage, fused: FusedRig) -> PointCloud:
    if stage.name == "after":
        return fused.cloud
    return fuse_surfaces(stage.surfaces, stage.poses, gains=fused.gains)


def _cut(stage: Stage, T_rig_view: Pose, limits: pictures.Array) -> Figure:
    picture = pictures.slice_picture(stage.surfaces, stage.poses, T_rig_view, limits)
    alt = f"Walls at camera height from above, {stage.name} the adjustment, one colour a camera"
    return Figure.drawing(picture, alt, _STAGES[stage.name])


def differ(stages: Sequence[Stage]) -> str | None:
    """By how much surfaces of neighbours differ where they overlap, before and after; None of none."""
    medians = [
        f"{np.median(list(stage.differences_mm.values())):.1f}" for stage in stages if stage.differences_mm
    ]
    return " → ".join(medians) + " mm" if medians else None
