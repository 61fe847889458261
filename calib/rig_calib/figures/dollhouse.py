"""A picture of a fused cloud from outside and above, with the walls and the ceiling in between left out."""

import numpy as np
import numpy.typing as npt

from rig_calib.fusion.cloud import PointCloud
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose, inverse, transform_points

Array = npt.NDArray[np.float64]

BACKGROUND = (24, 22, 20)
"""BGR."""

WIDTH_PX, HEIGHT_PX = 1280, 760
BACK_AZIMUTH_DEG, FRONT_AZIMUTH_DEG = 205.0, 25.0
"""Where the spectator stands: behind the rig, looking to its front, or before it."""

_ELEVATION_DEG = 42.0
_DISTANCE_RADII = 3.2
_FILLED = 0.92  # of the picture's width or height


def share_facing(cloud: PointCloud, T_rig_view: Pose, azimuth_deg: float) -> float:
    """The share (0 to 1) of the cloud that a spectator at this azimuth would see."""
    points = transform_points(inverse(T_rig_view), cloud.points_m.astype(np.float64))
    return float(np.mean(points @ spectator_direction(azimuth_deg) < 0)) if len(points) else 0.0


def dollhouse_picture(
    cloud: PointCloud,
    T_rig_view: Pose,
    azimuth_deg: float = BACK_AZIMUTH_DEG,
    framed_by: PointCloud | None = None,
) -> ImageU8:
    """The cloud (H,W,3), BGR, in perspective from an azimuth of the view frame.

    Every point faces the rig that saw it: those that turn their back on the spectator are left out. Pictures
    `framed_by` one cloud (default: their own) have the same spectator and scale.
    """
    towards = spectator_direction(azimuth_deg)
    image = np.full((HEIGHT_PX, WIDTH_PX, 3), BACKGROUND, np.uint8)
    points, colors = _facing(cloud, T_rig_view, towards)
    frame = points if framed_by is None else _facing(framed_by, T_rig_view, towards)[0]
    if not len(points) or not len(frame):
        return image
    radius = float(np.percentile(np.linalg.norm(frame, axis=1), 98))
    scale, left, top = fit_to_picture(*perspective(frame, towards, radius)[:2])
    across, up, depth = perspective(points, towards, radius)
    _splat(image, across * scale + left, top - up * scale, depth, colors)
    return image


def _facing(cloud: PointCloud, T_rig_view: Pose, towards: Array) -> tuple[Array, ImageU8]:
    """Points (N,3) in the view frame and colours (N,3) BGR of what the spectator sees."""
    points = transform_points(inverse(T_rig_view), cloud.points_m.astype(np.float64))
    facing = points @ towards < 0
    return points[facing], cloud.colors[facing][:, ::-1]


def spectator_direction(azimuth_deg: float) -> Array:
    """Unit vector (3,) of the view frame to who looks in from outside and above."""
    elevation, azimuth = np.deg2rad((_ELEVATION_DEG, azimuth_deg))
    across = np.cos(elevation)
    return np.array([np.cos(azimuth) * across, np.sin(azimuth) * across, np.sin(elevation)])


def perspective(points: Array, towards: Array, radius: float) -> tuple[Array, Array, Array]:
    """Image coordinates across and up, and the distance from the spectator, (N,) each."""
    right = np.cross([0.0, 0.0, 1.0], towards)
    right /= np.linalg.norm(right)
    depth = _DISTANCE_RADII * radius - points @ towards
    return points @ right / depth, points @ np.cross(towards, right) / depth, depth


def fit_to_picture(across: Array, up: Array) -> tuple[float, float, float]:
    """Pixels a unit and the place of the origin that fit the points into the picture."""
    low_x, high_x = np.percentile(across, (0.2, 99.8))
    low_y, high_y = np.percentile(up, (0.2, 99.8))
    scale = _FILLED * min(WIDTH_PX / max(high_x - low_x, 1e-9), HEIGHT_PX / max(high_y - low_y, 1e-9))
    left = WIDTH_PX / 2 - scale * (low_x + high_x) / 2
    return float(scale), float(left), float(HEIGHT_PX / 2 + scale * (low_y + high_y) / 2)


def _splat(image: ImageU8, x: Array, y: Array, depth: Array, colors: npt.NDArray[np.uint8]) -> None:
    """Draw every point as 3×3 pixels, the nearest last."""
    order = np.argsort(-depth)
    columns, rows = np.rint(x[order]).astype(np.intp), np.rint(y[order]).astype(np.intp)
    inner = (columns >= 1) & (columns < image.shape[1] - 1) & (rows >= 1) & (rows < image.shape[0] - 1)
    columns, rows, chosen = columns[inner], rows[inner], colors[order][inner]
    offsets = np.array([(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    index = ((rows[:, None] + offsets[:, 0]) * image.shape[1] + columns[:, None] + offsets[:, 1]).ravel()
    image.reshape(-1, 3)[index] = np.repeat(chosen, len(offsets), axis=0)
