"""The quality gate: what is wrong with a calibration, which cameras it concerns, and what to do."""

from collections.abc import Mapping, Sequence

import numpy as np

from rig_calib.consistency import ConsistentGraph, unconfirmed
from rig_calib.edges import Edge
from rig_calib.observed_camera import missing_images
from rig_calib.rig_adjustment import AdjustedRig
from rig_calib.settings import CalibrationSettings
from rig_calib.uncertainty import weakest_direction
from rig_calib.view import CameraView
from rig_protocol.poses import Pose, inverse, rotation_angle_deg
from rig_protocol.rig_folder import RingDrawing

_FAR = 5.0  # in tolerances of one axis; three axes together rarely exceed four
MORE_MATCHES = "put patterns or textured things where both look, 0.8 to 3 m away, where both have depth"


def unplaced(views: Sequence[CameraView], edges: Sequence[Edge], placed: Mapping[int, Pose]) -> list[str]:
    """A failure for every camera without a pose."""
    names = {view.camera_id: view.name for view in views}
    failures = []
    for view in views:
        absent = missing_images(view)
        if absent is not None:
            failures.append(f"camera {view.camera_id} ({view.name}) delivered {absent}: see that it streams")
        elif view.camera_id not in placed:
            failures.append(_unconnected(view, edges, names))
    return failures


def unclosed(graph: ConsistentGraph) -> list[str]:
    """A failure for every loop that does not close and may be wrong anywhere."""
    reasons = {edge.pair: edge.reason for edge in graph.edges}
    return [
        f"the loop through cameras {i} and {j} does not close (edge {i}–{j} {reasons[i, j]}), and without a "
        "drawing of the rig any of its edges may be the false one: give nominal poses, or more overlap"
        for i, j in graph.ambiguous
    ]


def unsupported(
    edges: Sequence[Edge], rig: AdjustedRig | None, drawn: bool, settings: CalibrationSettings
) -> tuple[list[str], list[str]]:
    """Failures and warnings about pairs whose relative pose lacks support.

    With a drawing every candidate is expected to hold. A pair whose relative pose the whole rig does not know
    well enough is a failure; one whose own matches leave something open that others make up for is a warning.
    Without a covariance (`rig` is None) it is a warning, too.
    """
    failures, warnings = [], []
    for edge in edges:
        sigma_deg, sigma_m = _relative_sigma(edge, rig)
        told = f"edge {edge.i}–{edge.j}: {edge.reason or 'its matches are few'}"
        if drawn and (sigma_deg > settings.max_pair_sigma_deg or sigma_m > settings.max_pair_sigma_m):
            failures.append(
                f"{told}; the relative pose of cameras {edge.i} and {edge.j} is only known to "
                f"{sigma_deg:.1f}° and {sigma_m * 1e3:.0f} mm: {MORE_MATCHES}"
            )
        elif edge.reason is not None and (drawn or _has_a_pose_of_its_own(edge, settings)):
            warnings.append(told)
    return failures, warnings


def _has_a_pose_of_its_own(edge: Edge, settings: CalibrationSettings) -> bool:
    return edge.T_i_j is not None and bool(edge.inlier.sum() >= 2 * settings.min_inliers)


def _relative_sigma(edge: Edge, rig: AdjustedRig | None) -> tuple[float, float]:
    """How well the rig knows the pair's relative pose (degrees, metres); 0 where nobody can say."""
    if rig is None or edge.i not in rig.poses or edge.j not in rig.poses:
        return 0.0, 0.0
    return weakest_direction(rig.relative(edge.i, edge.j)[1])


def unchecked(edges: Sequence[Edge], placed: Mapping[int, Pose]) -> list[str]:
    """A warning about the edges that nothing confirms."""
    used = [edge.pair for edge in edges if edge.reason is None and edge.i in placed]
    alone = unconfirmed(used, list(placed))
    if not alone or len(placed) < 3:
        return []
    named = ", ".join(f"{i}–{j}" for i, j in alone)
    return [
        f"no loop confirms edge{'s' if len(alone) > 1 else ''} {named}: a false match there would not show"
    ]


def far_from_drawing(views: Sequence[CameraView], poses: Mapping[int, Pose], ring: RingDrawing) -> list[str]:
    """A warning for every camera that sits far out of its tolerance."""
    warnings = []
    for view in views:
        if view.T_rig_nominal is None or view.camera_id not in poses:
            continue
        off = inverse(view.T_rig_nominal) @ poses[view.camera_id]
        off_deg, off_m = rotation_angle_deg(off), float(np.linalg.norm(off[:3, 3]))
        if off_deg > _FAR * ring.tolerance_deg or off_m > _FAR * ring.tolerance_m:
            warnings.append(
                f"camera {view.camera_id} ({view.name}) is {off_deg:.1f}° and {off_m * 1e3:.0f} mm from its "
                "drawing: see whether its mount was knocked or the drawing is another rig's"
            )
    return warnings


def _unconnected(view: CameraView, edges: Sequence[Edge], names: Mapping[int, str]) -> str:
    own = [edge for edge in edges if view.camera_id in edge.pair]
    told = f"camera {view.camera_id} ({view.name}) is not connected to the rig"
    if not own:
        return f"{told}: no other camera should see what it sees; check the nominal poses"
    best = max(own, key=lambda edge: (int(edge.inlier.sum()), len(edge.matches)))
    other = best.j if best.i == view.camera_id else best.i
    why = best.reason or "its partners are not connected either"
    return f"{told}; its best partner is camera {other} ({names[other]}), but {why}: {MORE_MATCHES}"
