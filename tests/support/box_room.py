"""An empty box of a room seen by a ring of small RGB-D cameras: geometry and colours known in closed form."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from rig_calib.depth_model import disparity_of_depth
from rig_calib.projection import pixel_rays
from rig_calib.rig_calibration import CalibratedCamera, RigCalibration
from rig_calib.view import CameraView
from rig_protocol.camera import CameraModel, Intrinsics
from rig_protocol.poses import Pose
from rig_protocol.rig_folder import RingDrawing

CAMERA = Intrinsics(131.0, 131.0, 79.5, 59.5, 160, 120)  # a Kinect's field at a quarter of its size
MODEL = CameraModel(color=CAMERA, depth=None, T_color_depth=None)


@dataclass(frozen=True)
class BoxRoom:
    """A room around the rig's origin; its colour is a smooth function of place."""

    half_size_m: np.ndarray = field(default_factory=lambda: np.array([2.0, 1.7, 1.2]))

    def distance_along(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Multiples of the rays (..., 3) at which they meet a wall."""
        ahead = np.where(rays == 0, np.inf, np.sign(rays) * self.half_size_m - origin)
        return (ahead / np.where(rays == 0, 1.0, rays)).min(axis=-1)

    def wall_error_m(self, points: np.ndarray) -> np.ndarray:
        """Distance (N,) of points near the walls from the nearest one."""
        return np.abs(self.half_size_m - np.abs(points)).min(axis=1)

    def colors(self, points: np.ndarray) -> np.ndarray:
        """RGB (..., 3), 60 to 200, at points of the walls."""
        return 130 + 70 * np.sin(points * np.array([1.5, 1.9, 2.3]) + np.array([0.0, 1.0, 2.0]))

    def view(self, camera_id: int, T_rig_camera: Pose, gain: float = 1.0, frames: int = 1) -> CameraView:
        """What a camera sees, its depth registered to colour, in millimetres."""
        rays = np.concatenate([pixel_rays(CAMERA), np.ones((CAMERA.height, CAMERA.width, 1))], axis=2)
        turned = rays @ T_rig_camera[:3, :3].T
        depth_m = self.distance_along(T_rig_camera[:3, 3], turned)
        colors = self.colors(T_rig_camera[:3, 3] + turned * depth_m[..., None]) * gain
        bgr = np.clip(np.rint(colors[..., ::-1]), 0, 255).astype(np.uint8)
        depth_mm = np.rint(depth_m * 1e3).astype(np.uint16)
        return CameraView(
            camera_id=camera_id,
            name=f"cam{camera_id:02d}",
            model=MODEL,
            color=(bgr,) * frames,
            depth_mm=(depth_mm,) * frames,
            depth_frame="color",
        )


def with_noise(view: CameraView, frames: int, sigma_steps: float = 0.5) -> CameraView:
    """The view with that many frames of raw disparity instead, noisy and quantised."""
    rng = np.random.default_rng(view.camera_id)
    disparity = disparity_of_depth(view.model.raw_model, view.depth_mm[0] * 1e-3)
    raw = [np.rint(disparity + rng.normal(0, sigma_steps, disparity.shape)) for _ in range(frames)]
    return CameraView(
        camera_id=view.camera_id,
        name=view.name,
        model=view.model,
        color=view.color[:1] * frames,
        raw=tuple(image.astype(np.uint16) for image in raw),
        depth_frame="color",
    )


def ring_poses(count: int = 12) -> dict[int, Pose]:
    """Poses of the first cameras of a ring of twelve."""
    return {slot: RingDrawing().T_rig_camera(slot) for slot in range(count)}


def calibration_of(poses: dict[int, Pose], rig_frame: str = "ring", **more: object) -> RigCalibration:
    """A calibration that knows exactly these poses."""
    cameras = tuple(CalibratedCamera(k, f"cam{k:02d}", T) for k, T in poses.items())
    values = {"edges": (), "loop_closure": None, "seconds": {}, "frames_used": 1, "cameras": cameras, **more}
    return RigCalibration(method="joint", rig_frame=rig_frame, **values)  # type: ignore[arg-type]


def room_views(poses: dict[int, Pose], gains: Sequence[float] = ()) -> list[CameraView]:
    """Views of the default room from these poses; camera k's exposure is `gains[k]`."""
    return [
        BoxRoom().view(camera_id, T, gains[k] if k < len(gains) else 1.0)
        for k, (camera_id, T) in enumerate(poses.items())
    ]
