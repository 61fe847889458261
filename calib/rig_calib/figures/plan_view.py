"""Plan of the rig from above as SVG: cameras, what they see, how well each is known, and the edges."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.displacement import ROOM_DISTANCE_M, PairUncertainty, least_certain
from rig_calib.figures.charts import ellipse, line, polygon, svg, text
from rig_calib.projection import undistort_pixels
from rig_calib.rig_calibration import CalibratedCamera, CalibratedEdge, RigCalibration
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import Pose, inverse

Array = npt.NDArray[np.float64]

_SIZE_PX, _MARGIN_PX = 620, 40
_FRUSTUM_RATIO = 0.7  # length of a frustum in units of the rig's radius
_SIGMAS_95 = 2.448  # 95 % of a 2-D normal distribution
_MAGNIFICATIONS = (100, 50, 30, 20, 15, 10, 8, 5, 4, 3, 2, 1)
_LABEL_PX = 42.0  # from a camera to its name, away from where it looks and clear of its ellipse
_ELLIPSE_PX = 26.0  # no ellipse is magnified beyond this radius
_PAIR_LABEL_RATIO = 0.75  # of a frustum's length, from the pair to its label
_NICE_LENGTHS_MM = (50.0, 20.0, 10.0, 5.0, 2.0, 1.0, 0.5, 0.2)
_NICE_LENGTHS_M = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
_MAX_UNUSED_EDGES = 12  # where all pairs were candidates, drawing the rejected ones would hide the rest


@dataclass(frozen=True, slots=True, eq=False)
class PlanView:
    """The drawing, and by how much its uncertainty ellipses (95 %) are magnified; None without any."""

    svg: str
    magnification: int | None


def plan_view(
    calibration: RigCalibration,
    intrinsics: Mapping[int, Intrinsics],
    T_rig_view: Pose,
    pairs: Sequence[PairUncertainty] = (),
) -> PlanView:
    """The rig from above, the front of the view up; `intrinsics` of the colour cameras by camera id.

    Each of the `pairs` is labelled with its displacement at `ROOM_DISTANCE_M`, the worst one stands out.
    """
    page = _Page.of(calibration.cameras, T_rig_view)
    covariances = _plan_covariances(calibration.cameras, T_rig_view)
    magnification = _magnification(covariances, page.px_per_m)
    worst = least_certain(pairs)
    parts = [_frustum(camera, intrinsics[camera.id], page) for camera in calibration.cameras]
    parts += [_edge(edge, calibration, page, worst) for edge in _drawn_edges(calibration)]
    for camera in calibration.cameras:
        here = page.position(camera.T_rig_camera)
        if camera.id in covariances and magnification:
            scale = (page.px_per_m * magnification) ** 2
            parts.append(ellipse(here, covariances[camera.id] * scale, _SIGMAS_95, "uncertainty"))
        parts.append(f'<circle class="camera" cx="{here[0]:.1f}" cy="{here[1]:.1f}" r="4"/>')
        away = page.direction(camera.T_rig_camera)
        label = here - _LABEL_PX * away
        parts.append(text(label[0], label[1] + 4, camera.name, "middle"))
    parts += [_pair_label(pair, calibration, page, pair is worst) for pair in pairs]
    parts += [_scale_bar(page), _ellipse_bar(page, magnification)]
    description = f"Plan of {len(calibration.cameras)} cameras from above with their fields of view"
    return PlanView(svg(_SIZE_PX, _SIZE_PX, description, parts), magnification)


@dataclass(frozen=True, slots=True, eq=False)
class _Page:
    """Where things of the rig frame lie on the page: the view's x is up, its y to the left."""

    T_view_rig: Pose
    centre: Array
    px_per_m: float
    frustum_m: float

    @classmethod
    def of(cls, cameras: Sequence[CalibratedCamera], T_rig_view: Pose) -> "_Page":
        T_view_rig = inverse(T_rig_view)
        places = np.array([(T_view_rig @ camera.T_rig_camera)[:2, 3] for camera in cameras])
        low, high = places.min(axis=0), places.max(axis=0)
        radius = max(float((high - low).max()) / 2, 0.05)
        frustum = _FRUSTUM_RATIO * radius
        return cls(T_view_rig, (low + high) / 2, (_SIZE_PX / 2 - _MARGIN_PX) / (radius + frustum), frustum)

    def points(self, points: Array) -> Array:
        """Page coordinates (N,2) of points (N,3) in the rig frame."""
        view = points @ self.T_view_rig[:3, :3].T + self.T_view_rig[:3, 3]
        return np.asarray(_SIZE_PX / 2 - self.px_per_m * (view[:, :2] - self.centre)[:, ::-1])

    def position(self, T_rig_camera: Pose) -> Array:
        return np.asarray(self.points(T_rig_camera[None, :3, 3])[0])

    def direction(self, T_rig_camera: Pose) -> Array:
        """Unit vector of the optical axis on the page."""
        ends = self.points(np.stack([T_rig_camera[:3, 3], T_rig_camera[:3, 3] + T_rig_camera[:3, 2]]))
        return np.asarray((ends[1] - ends[0]) / max(float(np.linalg.norm(ends[1] - ends[0])), 1e-9))


def _frustum(camera: CalibratedCamera, intrinsics: Intrinsics, page: _Page) -> str:
    width, height = intrinsics.width - 1.0, intrinsics.height - 1.0
    corners = undistort_pixels(intrinsics, np.array([[0, 0], [width, 0], [width, height], [0, height]]))
    rays = np.column_stack([np.nan_to_num(corners), np.ones(4)]) * page.frustum_m
    local = np.concatenate([np.zeros((1, 3)), rays])
    outline = page.points(local @ camera.T_rig_camera[:3, :3].T + camera.T_rig_camera[:3, 3])
    hull = cv2.convexHull(outline.astype(np.float32)).reshape(-1, 2)
    return polygon(np.asarray(hull, dtype=np.float64), "frustum")


def _drawn_edges(calibration: RigCalibration) -> list[CalibratedEdge]:
    placed = [edge for edge in calibration.edges if {edge.i, edge.j} <= calibration.poses.keys()]
    unused = [edge for edge in placed if not edge.used]
    used = [edge for edge in placed if edge.used]
    return used + (unused if len(unused) <= _MAX_UNUSED_EDGES else [])


def _edge(
    edge: CalibratedEdge, calibration: RigCalibration, page: _Page, worst: PairUncertainty | None
) -> str:
    start, end = (page.position(calibration.poses[camera_id]) for camera_id in (edge.i, edge.j))
    css = "edge" if edge.used else "edge edge-unused"
    if worst is not None and (worst.i, worst.j) == (edge.i, edge.j):
        css += " edge-worst"
    return line(start[0], start[1], end[0], end[1], css)


def _pair_label(pair: PairUncertainty, calibration: RigCalibration, page: _Page, worst: bool) -> str:
    """Millimetres of displacement, where the two fields of view meet."""
    middle = np.mean([page.position(calibration.poses[c]) for c in (pair.i, pair.j)], axis=0)
    away = np.array([-np.sin(pair.azimuth_rad), -np.cos(pair.azimuth_rad)])
    x, y = middle + _PAIR_LABEL_RATIO * page.frustum_m * page.px_per_m * away
    css = "label worst" if worst else "label strong"
    return text(x, y + 4, f"{pair.displacement_mm(ROOM_DISTANCE_M):.1f}", "middle", css)


def _plan_covariances(cameras: Sequence[CalibratedCamera], T_rig_view: Pose) -> dict[int, Array]:
    """Covariance (2,2) of each position in the rig on the page's axes, m²."""
    to_page = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]]) @ T_rig_view[:3, :3].T
    found = {}
    for camera in cameras:
        if camera.aligned_covariance is not None:
            turn = to_page @ camera.T_rig_camera[:3, :3]
            found[camera.id] = turn @ camera.aligned_covariance[3:, 3:] @ turn.T
    return found


def _magnification(covariances: Mapping[int, Array], px_per_m: float) -> int | None:
    if not covariances:
        return None
    largest = max(float(np.linalg.eigvalsh(covariance)[-1]) for covariance in covariances.values())
    radius_px = _SIGMAS_95 * np.sqrt(max(largest, 0.0)) * px_per_m
    return next((factor for factor in _MAGNIFICATIONS if radius_px * factor <= _ELLIPSE_PX), 1)


def _scale_bar(page: _Page) -> str:
    fitting = [length for length in _NICE_LENGTHS_M if length * page.px_per_m <= _SIZE_PX / 4]
    length_m = fitting[0] if fitting else _NICE_LENGTHS_M[-1]
    y, x = _SIZE_PX - 14.0, 14.0
    return line(x, y, x + length_m * page.px_per_m, y, "ink") + text(x, y - 8, f"{length_m * 100:g} cm")


def _ellipse_bar(page: _Page, magnification: int | None) -> str:
    """The scale of the ellipses, which is not the drawing's."""
    if magnification is None:
        return ""
    px_per_mm = page.px_per_m * magnification * 1e-3
    length_mm = next((length for length in _NICE_LENGTHS_MM if length * px_per_mm <= _SIZE_PX / 8), 0.1)
    y, x = _SIZE_PX - 14.0, _SIZE_PX - 14.0
    label = text(x, y - 8, f"ellipses: {length_mm:g} mm (× {magnification})", "end")
    return line(x - length_mm * px_per_mm, y, x, y, "ink") + label
