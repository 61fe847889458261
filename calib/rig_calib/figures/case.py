"""ReportCase: all that one report is about, and what several of its sections need of it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rig_calib.depth_model import DepthCorrection, depth_grid
from rig_calib.displacement import PairUncertainty, pair_uncertainties
from rig_calib.evidence import EdgeEvidence
from rig_calib.fusion.agreement import overlap_differences_m
from rig_calib.fusion.fused import FusedRig
from rig_calib.fusion.surface import Surface
from rig_calib.fusion.viewpoint import Viewpoint, rig_viewpoint
from rig_calib.projection import from_pixels, project
from rig_calib.rig_calibration import RigCalibration
from rig_calib.view import CameraView
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import Pose, inverse, transform_points

Pair = tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """The rig's surfaces as they were before loop closure and depth correction, or as they are after.

    `poses` are T_rig_camera; `differences_mm` (median, by pair of ids) is by how much surfaces of two cameras
    differ where they overlap.
    """

    name: str
    poses: Mapping[int, Pose]
    surfaces: tuple[Surface, ...]
    differences_mm: Mapping[Pair, float]

    def surface(self, camera_id: int) -> Surface | None:
        """What one camera contributes."""
        return next((surface for surface in self.surfaces if surface.camera_id == camera_id), None)


@dataclass(frozen=True, slots=True, eq=False)
class ReportCase:
    """Calibration, views and evidence; `stages` hold `before` (where it is known) and `after`."""

    calibration: RigCalibration
    views: Sequence[CameraView]
    evidence: Sequence[EdgeEvidence]
    fused: FusedRig | None
    viewpoint: Viewpoint | None
    pairs: Sequence[PairUncertainty]
    stages: Sequence[Stage]

    @classmethod
    def of(
        cls,
        calibration: RigCalibration,
        views: Sequence[CameraView],
        evidence: Sequence[EdgeEvidence] = (),
        poses_before: Mapping[int, Pose] | None = None,
        fused: FusedRig | None = None,
    ) -> "ReportCase":
        """Look at everything once."""
        viewpoint = rig_viewpoint(calibration.poses, calibration.rig_frame) if calibration.cameras else None
        pairs = pair_uncertainties(calibration, viewpoint.T_rig_view) if viewpoint else []
        stages = tuple(_stages(calibration, views, poses_before, fused)) if fused else ()
        return cls(calibration, views, evidence, fused, viewpoint, pairs, stages)

    @property
    def names(self) -> dict[int, str]:
        """Of the cameras by id."""
        return {view.camera_id: view.name for view in self.views}

    @property
    def intrinsics(self) -> dict[int, Intrinsics]:
        """Of the colour cameras by id."""
        return {view.camera_id: view.model.color for view in self.views}

    def view(self, camera_id: int) -> CameraView:
        """One camera's."""
        return next(view for view in self.views if view.camera_id == camera_id)

    def pair(self, i: int, j: int) -> PairUncertainty | None:
        """What is unknown of one overlap."""
        return next((pair for pair in self.pairs if {pair.i, pair.j} == {i, j}), None)

    def stage(self, name: str) -> Stage | None:
        """`before` or `after`."""
        return next((stage for stage in self.stages if stage.name == name), None)

    def is_left(self, i: int, j: int) -> bool:
        """Does camera i look to the left of camera j?"""
        poses = self.calibration.poses
        if self.viewpoint is None or not {i, j} <= poses.keys():
            return True
        return bool(np.cross(poses[j][:3, 2], poses[i][:3, 2]) @ self.viewpoint.T_rig_view[:3, 2] > 0)


def _stages(
    calibration: RigCalibration,
    views: Sequence[CameraView],
    poses_before: Mapping[int, Pose] | None,
    fused: FusedRig,
) -> Iterator[Stage]:
    by_id = {view.camera_id: view for view in views}
    after = calibration.poses
    if poses_before:
        before = _anchored(poses_before, after)
        uncorrected = [
            _uncorrected(surface, by_id[surface.camera_id], camera.depth_correction)
            for surface in fused.surfaces
            if surface.camera_id in before and (camera := calibration.camera(surface.camera_id))
        ]
        yield _stage("before", before, uncorrected, by_id)
    yield _stage("after", after, [s for s in fused.surfaces if s.camera_id in after], by_id)


def _stage(
    name: str, poses: Mapping[int, Pose], surfaces: Sequence[Surface], views: Mapping[int, CameraView]
) -> Stage:
    intrinsics = {camera_id: view.model.color for camera_id, view in views.items()}
    both_ways: dict[Pair, list[float]] = {}
    for (i, j), difference_m in overlap_differences_m(surfaces, intrinsics, poses).items():
        both_ways.setdefault((min(i, j), max(i, j)), []).append(difference_m * 1e3)
    return Stage(name, poses, tuple(surfaces), {pair: float(np.mean(d)) for pair, d in both_ways.items()})


def _anchored(before: Mapping[int, Pose], after: Mapping[int, Pose]) -> dict[int, Pose]:
    """Poses before loop closure in the frame of those after it: their first common camera stays in place."""
    common = sorted(before.keys() & after.keys())
    if not common:
        return dict(before)
    T_after_before = after[common[0]] @ inverse(before[common[0]])
    return {camera_id: T_after_before @ T for camera_id, T in before.items()}


def _uncorrected(surface: Surface, view: CameraView, correction: DepthCorrection | None) -> Surface:
    """The surface as measured: every point moved back along its ray of the depth camera."""
    if correction is None:
        return surface
    grid = depth_grid(view.model, view.depth_frame)
    points = transform_points(inverse(grid.T_color_grid), surface.points_m.astype(np.float64))
    x, y = from_pixels(grid.intrinsics, project(grid.intrinsics, points)).T
    points /= correction.factor(x, y)[:, None]
    return replace(surface, points_m=transform_points(grid.T_color_grid, points).astype(np.float32))
