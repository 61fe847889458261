"""What the report says in words and numbers: verdict, key figures, rows of the tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.displacement import (
    ROOM_DISTANCE_M,
    PairUncertainty,
    least_certain,
    pair_uncertainties,
    worst_pair,
)
from rig_calib.evidence import EdgeEvidence
from rig_calib.figures.case import Stage
from rig_calib.fusion.viewpoint import Viewpoint, rig_viewpoint
from rig_calib.rig_calibration import CalibratedCamera, CalibratedEdge, RigCalibration
from rig_calib.uncertainty import weakest_direction
from rig_calib.view import CameraView
from rig_protocol.poses import Pose, inverse, rotation_angle_deg

Array = npt.NDArray[np.float64]

UNKNOWN = "–"
DISTANCES_M = (1.0, 2.0, 3.0, 4.0)


@dataclass(frozen=True, slots=True)
class Sigma:
    """Standard deviations of a pose in its least certain direction."""

    deg: float
    mm: float

    def __str__(self) -> str:
        """As `0.08° / 2.5 mm`."""
        return f"{self.deg:.2f}° / {self.mm:.1f} mm"


def worst_sigma(covariance: Array | None) -> Sigma | None:
    """Of a pose's covariance (6,6); None when there is none, or when the pose defines the frame."""
    if covariance is None or not covariance.any():
        return None
    deg, m = weakest_direction(covariance)
    return Sigma(deg, m * 1e3)


def verdict(calibration: RigCalibration, expected: int) -> str:
    """One sentence: did it pass, and how good is it or how much is wrong."""
    placed = len(calibration.cameras)
    if calibration.failures:
        count = len(calibration.failures)
        problems = "one problem" if count == 1 else f"{count} problems"
        return f"The calibration did not pass: {problems} to solve, {placed} of {expected} cameras placed."
    everyone = f"all {placed} cameras" if placed == expected else f"{placed} of {expected} cameras"
    return f"The calibration passed: {everyone} are placed. {_certainty(calibration)}"


def _certainty(calibration: RigCalibration) -> str:
    """How well neighbours are known against each other: the worst pair, in words and millimetres."""
    pairs: list[PairUncertainty] = []
    if calibration.cameras:
        T_rig_view = rig_viewpoint(calibration.poses, calibration.rig_frame).T_rig_view
        pairs = pair_uncertainties(calibration, T_rig_view)
    worst = worst_pair(pairs, ROOM_DISTANCE_M)
    if worst is None:
        return f"It states no uncertainty of relative poses (method {calibration.method})."
    names = {camera.id: camera.name for camera in calibration.cameras}
    motion, mm = worst.weakest_motion(ROOM_DISTANCE_M), worst.displacement_mm(ROOM_DISTANCE_M)
    return (
        f"Least certain: {names[worst.j]} against {names[worst.i]}, {motion}; "
        f"points at {ROOM_DISTANCE_M:g} m are displaced by {mm:.1f} mm (one standard deviation)."
    )


def key_figures(calibration: RigCalibration, expected: int) -> dict[str, str]:
    """The few numbers that one looks at first, by their label."""
    used = sum(edge.used for edge in calibration.edges)
    figures = {
        "cameras placed": f"{len(calibration.cameras)} of {expected}",
        "edges used": f"{used} of {len(calibration.edges)}",
    }
    loop = calibration.loop_closure
    if loop is not None:
        figures["loop before"] = f"{loop.before_deg:.2f}° / {loop.before_mm:.1f} mm"
        figures["loop after"] = f"{loop.after_deg:.2f}° / {loop.after_mm:.1f} mm"
    felt = calibration.provenance.get("gravity_cameras")
    if isinstance(felt, list):
        figures["down felt by"] = f"{len(felt)} of {expected} cameras"
    if "total" in calibration.seconds:
        figures["calibration time"] = f"{calibration.seconds['total']:.1f} s"
    return figures


def camera_rows(
    calibration: RigCalibration, views: Sequence[CameraView], viewpoint: Viewpoint | None
) -> list[dict[str, str]]:
    """A row for every camera of the capture, those that could not be placed included."""
    rows = []
    for view in views:
        camera = calibration.camera(view.camera_id)
        row = {"name": view.name, "id": str(view.camera_id), "placed": "yes" if camera else ""}
        if camera is not None and viewpoint is not None:
            row |= _pose_cells(camera, viewpoint)
            drawing = view.T_rig_nominal if calibration.rig_frame == "ring" else None
            row["off_drawing"] = _difference(camera.T_rig_camera, drawing)
        rows.append(row)
    return rows


def edge_rows(
    calibration: RigCalibration, names: Mapping[int, str], evidence: Sequence[EdgeEvidence]
) -> list[dict[str, str]]:
    """A row for every edge, the used ones first."""
    rows = []
    for edge in sorted(calibration.edges, key=lambda edge: (not edge.used, edge.i, edge.j)):
        residuals = kept_residuals([item for item in evidence if {item.i, item.j} == {edge.i, edge.j}])
        rows.append(
            {
                "pair": f"{names.get(edge.i, edge.i)} – {names.get(edge.j, edge.j)}",
                "matches": str(edge.matches),
                "inliers": str(edge.inliers),
                "rms_mm": f"{edge.rms_mm:.1f}" if edge.inliers else UNKNOWN,
                "median_px": f"{np.median(residuals):.2f}" if len(residuals) else UNKNOWN,
                "sigma": str(worst_sigma(edge.relative_covariance) or UNKNOWN),
                "moved": _moved(edge, calibration.poses),
                "used": "yes" if edge.used else "",
                "reason": edge.reason or "",
            }
        )
    return rows


def _moved(edge: CalibratedEdge, poses: Mapping[int, Pose]) -> str:
    """How far the adjusted relative pose is from what the edge alone measured."""
    if not edge.used or not {edge.i, edge.j} <= poses.keys():
        return UNKNOWN
    return _difference(inverse(poses[edge.i]) @ poses[edge.j], edge.T_i_j)


def displacement_rows(
    calibration: RigCalibration, pairs: Sequence[PairUncertainty], stages: Sequence[Stage]
) -> list[dict[str, str]]:
    """A row for every overlap around the rig: millimetres at each distance, and what causes most of them."""
    names = {camera.id: camera.name for camera in calibration.cameras}
    worst = least_certain(pairs)
    return [
        {
            "pair": f"{names[pair.i]} – {names[pair.j]}",
            "worst": "yes" if pair is worst else "",
            "sigma": str(Sigma(*pair.sigma)),
            **{f"at_{d:g}": f"{pair.displacement_mm(d):.1f}" for d in DISTANCES_M},
            "weakest": str(pair.weakest_motion(ROOM_DISTANCE_M)),
            "differ": _differ(pair, stages),
        }
        for pair in pairs
    ]


def _differ(pair: PairUncertainty, stages: Sequence[Stage]) -> str:
    """By how much the two surfaces differ, before and after."""
    key = (min(pair.i, pair.j), max(pair.i, pair.j))
    known = [f"{stage.differences_mm[key]:.1f}" for stage in stages if key in stage.differences_mm]
    return " → ".join(known) or UNKNOWN


def kept_residuals(evidence: Sequence[EdgeEvidence]) -> Array:
    """Residuals (N,) of the inliers, px."""
    return _finite([item.residual_px[item.inlier] for item in evidence])


def rejected_residuals(evidence: Sequence[EdgeEvidence]) -> Array:
    """Residuals (N,) of the rejected matches, px."""
    return _finite([item.residual_px[~item.inlier] for item in evidence])


def flatten(values: Mapping[str, object], prefix: str = "") -> dict[str, str]:
    """Nested mappings as `outer.inner` keys with printable values."""
    flat: dict[str, str] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = str(value)
    return flat


def _finite(parts: Sequence[Array]) -> Array:
    values = np.concatenate([np.empty(0), *parts])
    return np.asarray(values[np.isfinite(values)])


def _pose_cells(camera: CalibratedCamera, viewpoint: Viewpoint) -> dict[str, str]:
    R = inverse(viewpoint.T_rig_view)[:3, :3] @ camera.T_rig_camera[:3, :3]
    axis, image_up = R[:, 2], -R[:, 0 if viewpoint.portrait else 1]
    right = np.array([axis[1], -axis[0], 0.0]) / max(float(np.hypot(axis[0], axis[1])), 1e-9)
    roll = float(np.arctan2(image_up @ right, image_up @ np.cross(right, axis)))
    x, y, z = camera.T_rig_camera[:3, 3] * 1e3
    sigma, in_frame = worst_sigma(camera.aligned_covariance), worst_sigma(camera.covariance)
    correction = camera.depth_correction
    return {
        "position": f"{x:.1f}, {y:.1f}, {z:.1f}",
        "azimuth": _degrees(np.arctan2(axis[1], axis[0])),
        "elevation": _degrees(np.arcsin(np.clip(axis[2], -1, 1))),
        "roll": _degrees(roll),
        "sigma_deg": f"{sigma.deg:.3f}" if sigma else UNKNOWN,
        "sigma_mm": f"{sigma.mm:.2f}" if sigma else UNKNOWN,
        "sigma": str(sigma or UNKNOWN),
        "sigma_frame": str(in_frame or UNKNOWN),
        "depth_scale": f"{100 * correction.coefficients[0]:+.2f} %" if correction else UNKNOWN,
    }


def _degrees(angle_rad: float) -> str:
    return f"{np.rad2deg(angle_rad):z.2f}"


def _difference(T: Pose, drawing: Pose | None) -> str:
    if drawing is None:
        return UNKNOWN
    difference = inverse(drawing) @ T
    return f"{rotation_angle_deg(difference):.2f}° / {np.linalg.norm(difference[:3, 3]) * 1e3:.1f} mm"
