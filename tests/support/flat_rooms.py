"""Rooms of flat pieces without any texture, as depth cameras see them: known in closed form."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from rig_agent.simulator.kinect_noise import smooth_field
from rig_calib.depth_model import depth_grid, disparity_of_depth
from rig_calib.features import Keypoints
from rig_calib.keypoint_depth import KeypointDepth
from rig_calib.observed_camera import ObservedCamera
from rig_calib.projection import pixel_rays
from rig_calib.view import CameraView
from rig_protocol.camera import CameraModel
from rig_protocol.poses import Pose

MODEL = CameraModel(source="factory")
GRID = depth_grid(MODEL, "depth")
RAYS = np.concatenate([pixel_rays(GRID.intrinsics), np.ones((480, 640, 1))], axis=2)
_NOWHERE = np.full(3, np.inf)


@dataclass(frozen=True)
class Piece:
    """The part of the plane π · X = 1, rig frame, that lies between two corners of a box."""

    plane: np.ndarray
    low: np.ndarray = field(default_factory=lambda: -_NOWHERE)
    high: np.ndarray = field(default_factory=lambda: _NOWHERE)


def box(half_size_m: Sequence[float] = (2.0, 1.8, 1.2)) -> list[Piece]:
    """Four walls, floor and ceiling around the rig, turned by 20 degrees about the vertical."""
    c, s = np.cos(np.deg2rad(20.0)), np.sin(np.deg2rad(20.0))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return [Piece(sign * R[:, k] / half_size_m[k]) for k in range(3) for sign in (1, -1)]


def inverse_depth(pieces: Sequence[Piece], T_rig_grid: Pose) -> np.ndarray:
    """1/z (480,640) of what is nearest; 0 for nothing."""
    R, t = T_rig_grid[:3, :3], T_rig_grid[:3, 3]
    nearest = np.zeros(RAYS.shape[:2])
    for piece in pieces:
        seen = RAYS @ (R.T @ piece.plane) / (1.0 - piece.plane @ t)
        points = t + RAYS @ R.T / np.where(seen > 0, seen, np.nan)[..., None]
        inside = (points >= piece.low).all(axis=2) & (points <= piece.high).all(axis=2)
        nearest = np.where(inside & (seen > nearest), seen, nearest)
    return nearest


@dataclass(frozen=True)
class Unit:
    """What one unit does to depth: a scale, a smooth bend of it (peak to peak, as a share), white noise."""

    scale: float = 0.0
    bend: float = 0.0
    noise: float = 0.5

    def disparity(self, inverse_depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """What it measures (480,640); NaN = none."""
        share = 1.0 + self.scale + self.bend * smooth_field(rng, inverse_depth.shape)
        with np.errstate(divide="ignore"):
            exact = disparity_of_depth(GRID.raw_model, 1.0 / inverse_depth * share)
        noisy = np.rint(exact + self.noise * rng.standard_normal(exact.shape))
        return np.where(inverse_depth > 0.0, noisy, np.nan)


def observed(camera_id: int, disparity: np.ndarray, T_rig_nominal: Pose | None = None) -> ObservedCamera:
    """A camera that recognises nothing and has this depth."""
    view = CameraView(camera_id, f"cam{camera_id:02d}", MODEL, (), T_rig_nominal=T_rig_nominal)
    nothing = Keypoints(
        np.empty((0, 2)), np.empty((0, 2, 2)), np.empty((0, 0), np.float32), np.empty(0, np.intp)
    )
    no_depth = KeypointDepth(np.empty(0), np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
    blank = np.zeros((480, 640), np.float32)
    return ObservedCamera(view, GRID, blank, disparity, nothing, no_depth, np.empty((0, 3)))
