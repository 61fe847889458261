"""Range images of planes and of the box room, known in closed form."""

from collections.abc import Mapping

import numpy as np

from rig_calib.depth_model import DepthGrid
from rig_calib.projection import pixel_rays
from rig_calib.tsdf.range_image import RangeImage
from rig_protocol.camera import RawDepthModel
from rig_protocol.poses import Pose
from support.box_room import CAMERA, BoxRoom

KINECT_SIGMA_1M = 0.5 / RawDepthModel().numerator_m
RAYS = np.dstack([pixel_rays(CAMERA), np.ones((CAMERA.height, CAMERA.width))])


def range_image(
    depth_m: np.ndarray,
    incidence: np.ndarray,
    T_rig_grid: Pose | None = None,
    sigma_1m: float = KINECT_SIGMA_1M,
    color: tuple[int, int, int] = (200, 100, 50),
    frames: int = 1,
) -> RangeImage:
    """What a small camera measured, depth 0 being none."""
    measured = depth_m > 0
    return RangeImage(
        grid=DepthGrid(CAMERA, np.eye(4), RawDepthModel()),
        T_rig_grid=np.eye(4) if T_rig_grid is None else T_rig_grid,
        inverse_depth=np.where(measured, 1 / np.where(measured, depth_m, 1), 0).astype(np.float32),
        incidence=incidence.astype(np.float32),
        colors=np.broadcast_to(np.array(color, np.uint8), (*depth_m.shape, 3)).copy(),
        colored=measured,
        sigma_1m=sigma_1m,
        frames=frames,
    )


def facing_plane(z_m: float, **more: object) -> RangeImage:
    """A plane at right angles to the camera's axis."""
    return range_image(np.full(RAYS.shape[:2], z_m), 1 / np.linalg.norm(RAYS, axis=2), **more)  # type: ignore[arg-type]


def room_images(poses: Mapping[int, Pose]) -> list[RangeImage]:
    """The default box room, without noise."""
    room, images = BoxRoom(), []
    for T in poses.values():
        turned = RAYS @ T[:3, :3].T
        depth_m = room.distance_along(T[:3, 3], turned)
        wall = np.abs(np.abs(T[:3, 3] + turned * depth_m[..., None]) - room.half_size_m).argmin(axis=2)
        along = np.take_along_axis(np.abs(turned), wall[..., None], axis=2)[..., 0]
        images.append(range_image(depth_m, along / np.linalg.norm(turned, axis=2), T))
    return images
