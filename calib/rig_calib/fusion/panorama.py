"""Cylindrical RGB-D panorama around the axis of a rig: colour and distance of all cameras at once."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.fusion.cylinder import Cylinder, complete, fill_small_holes, fit_cylinder, splat_distance
from rig_calib.fusion.gains import NO_GAIN, Gain, color_gains
from rig_calib.fusion.sampling import mean_color, sample_colors
from rig_calib.fusion.surface import Array32, Surface, camera_surfaces, frames_of
from rig_calib.fusion.viewpoint import rig_viewpoint
from rig_calib.fusion.visibility import DepthBuffer, in_field
from rig_calib.projection import inside, project
from rig_calib.rig_calibration import RigCalibration
from rig_calib.view import CameraView
from rig_protocol.camera import Intrinsics
from rig_protocol.errors import DataError
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose, inverse, transform_points

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

DEFAULT_CIRCLE_PX = 3000
"""Columns of a full circle: about the angular resolution of a Kinect's colour camera."""

_COS_ASIDE = np.cos(np.deg2rad(60.0))  # what is farther from a camera's axis is not even looked at
_SEAM_POWER = 4.0  # how fast a camera's weight falls towards its border: sharp enough not to ghost
_HIDDEN_WEIGHT = 1e-6  # a camera from which a pixel is hidden colours it only where no other can


@dataclass(frozen=True, slots=True, eq=False)
class Panorama:
    """`color` (H,W,3) BGR and `depth_m` (H,W), the distance from the axis, NaN where nothing was measured.

    `T_rig_view`: the frame of the cylinder, z its axis. `camera_azimuths_rad`: where each camera looks.
    Colour is drawn at distances guessed from around where none was measured.
    """

    color: ImageU8
    depth_m: Array32
    cylinder: Cylinder
    T_rig_view: Pose
    camera_azimuths_rad: Mapping[str, float]
    skipped: tuple[str, ...] = ()


def render_panorama(
    views: Sequence[CameraView],
    calibration: RigCalibration,
    frame: int | None = None,
    circle_px: int = DEFAULT_CIRCLE_PX,
    equalise_colors: bool = True,
) -> Panorama:
    """What the rig sees from its centre; cameras without pose or depth are named in `skipped`.

    `frame` picks one panoramic frame, None averages them all. DataError when no camera can contribute.
    """
    surfaces, skipped = camera_surfaces(views, calibration, frame)
    gains = color_gains(surfaces, calibration.poses) if equalise_colors else {}
    return render_surfaces(surfaces, views, calibration, gains, frame, circle_px, skipped)


def render_surfaces(
    surfaces: Sequence[Surface],
    views: Sequence[CameraView],
    calibration: RigCalibration,
    gains: Mapping[int, Gain],
    frame: int | None = None,
    circle_px: int = DEFAULT_CIRCLE_PX,
    skipped: tuple[str, ...] = (),
) -> Panorama:
    """`render_panorama` of surfaces that are there already; `views` hold their images."""
    surfaces = [surface for surface in surfaces if len(surface.points_m)]
    if not surfaces:
        raise DataError("no camera has a pose, colour and depth: there is nothing to draw a panorama of")
    used = {surface.camera_id: calibration.poses[surface.camera_id] for surface in surfaces}
    T_rig_view = rig_viewpoint(used, calibration.rig_frame).T_rig_view
    poses = {camera_id: inverse(T_rig_view) @ T_rig_camera for camera_id, T_rig_camera in used.items()}
    cylinder, distance = _render_distance(surfaces, poses, circle_px)
    points = cylinder.rays() * complete(distance, cylinder.closed)[..., None]
    layers = _layers(surfaces, views, poses, gains, frame)
    return Panorama(
        _blend(points, layers), distance, cylinder, T_rig_view, _azimuths(surfaces, poses), skipped
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Layer:
    """What one camera paints on the panorama."""

    surface: Surface
    view: CameraView
    T_view_camera: Pose
    gain: Gain
    frame: int | None

    def paint(self, points: Array32) -> tuple[npt.NDArray[np.intp], Array32, Array]:
        """Flat pixel indices (N,), their RGB (N,3) and weights (N,) for panorama points (H,W,3)."""
        intrinsics = self.view.model.color
        index = _towards(points, self.T_view_camera)
        local = transform_points(inverse(self.T_view_camera), points.reshape(-1, 3)[index].astype(np.float64))
        shown = in_field(intrinsics, local)
        index, local = index[shown], local[shown]
        pixels = project(intrinsics, local)
        seen = inside(intrinsics, pixels)
        index, local, pixels = index[seen], local[seen], pixels[seen]
        own = self.surface.points_m.astype(np.float64)
        buffer = DepthBuffer.of(project(intrinsics, own), own[:, 2])
        hidden = ~buffer.visible(pixels, local[:, 2])
        weight = _centre_weight(intrinsics, pixels) ** _SEAM_POWER * np.where(hidden, _HIDDEN_WEIGHT, 1.0)
        image = mean_color([self.view.color[k] for k in frames_of(self.view, self.frame)])
        return index, (sample_colors(image, pixels) * self.gain).astype(np.float32), weight


def _layers(
    surfaces: Sequence[Surface],
    views: Sequence[CameraView],
    poses: Mapping[int, Pose],
    gains: Mapping[int, Gain],
    frame: int | None,
) -> Iterator[_Layer]:
    by_id = {view.camera_id: view for view in views}
    for surface in surfaces:
        camera_id = surface.camera_id
        yield _Layer(surface, by_id[camera_id], poses[camera_id], gains.get(camera_id, NO_GAIN), frame)


def _azimuths(surfaces: Sequence[Surface], poses: Mapping[int, Pose]) -> dict[str, float]:
    axes = {surface.name: poses[surface.camera_id][:2, 2] for surface in surfaces}
    return {name: float(np.arctan2(axis[1], axis[0])) for name, axis in axes.items()}


def _render_distance(
    surfaces: Sequence[Surface], poses: Mapping[int, Pose], circle_px: int
) -> tuple[Cylinder, Array32]:
    points = np.concatenate([surface.points_at(poses[surface.camera_id]) for surface in surfaces])
    sigma = np.concatenate([surface.sigma_m for surface in surfaces])
    cylinder = fit_cylinder(points, circle_px)
    return cylinder, fill_small_holes(splat_distance(cylinder, points, sigma), cylinder.closed)


def _towards(points: Array32, T_view_camera: Pose) -> npt.NDArray[np.intp]:
    """Flat indices of the panorama points that lie roughly where the camera looks."""
    axis = T_view_camera[:3, 2].astype(np.float32)
    along = points @ axis
    return np.flatnonzero(along > _COS_ASIDE * np.linalg.norm(points, axis=-1))


def _centre_weight(intrinsics: Intrinsics, pixels: Array) -> Array:
    """One in the middle of the image, zero at its border (nearly)."""
    size = np.array([intrinsics.width - 1, intrinsics.height - 1])
    return np.asarray(np.minimum(pixels, size - pixels).min(axis=1).clip(0.5) / (size.min() / 2))


def _blend(points: Array32, layers: Iterable[_Layer]) -> ImageU8:
    """Weighted mean (H,W,3), BGR, of what the layers paint; black where none does."""
    size = points.shape[0] * points.shape[1]
    total, colors = np.zeros(size), np.zeros((size, 3))
    for layer in layers:
        index, rgb, weight = layer.paint(points)
        total[index] += weight
        colors[index] += weight[:, None] * rgb
    mean = colors / np.maximum(total, 1e-300)[:, None]
    image = np.clip(np.rint(mean[:, ::-1]), 0, 255).astype(np.uint8)
    return image.reshape(*points.shape[:2], 3)
