"""A ring of cameras that see numbered points: keypoints, disparity and matches without any image."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import scipy.spatial

from rig_calib.depth_model import depth_grid, disparity_of_depth
from rig_calib.features import Keypoints
from rig_calib.keypoint_depth import KeypointDepth, keypoint_points
from rig_calib.observed_camera import ObservedCamera
from rig_calib.projection import inside, project
from rig_calib.view import CameraView
from rig_protocol.camera import CameraModel, Intrinsics
from rig_protocol.poses import Pose, inverse, se3_exp, transform_points
from rig_protocol.rig_folder import RingDrawing

Array = npt.NDArray[np.float64]

COLOR = Intrinsics(525.0, 525.0, 319.5, 239.5)
DEPTH = Intrinsics(580.0, 580.0, 319.5, 239.5)
MODEL = CameraModel(color=COLOR, depth=DEPTH, source="factory")
IMAGE = np.zeros((480, 640), dtype=np.uint8)
NO_DEPTH = np.full((480, 640), 2047, dtype=np.uint16)
ASSUMED_SIGMA_PX = float(np.hypot(0.25, 0.05))
"""What the settings say of a keypoint of one pixel's size."""
_SAME_PIXEL_PX = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticCamera(ObservedCamera):
    """A camera that knows depth at its numbered points and nowhere else, whatever its images say."""

    seen_pixels: Array
    seen_depth: KeypointDepth

    def depth_at(self, pixels: Array) -> KeypointDepth:
        """Depth of the points at exactly these pixels; none where there is no point."""
        count = len(self.seen_pixels)
        if not count:
            return _no_depth(len(pixels))
        distance_px, row = scipy.spatial.KDTree(self.seen_pixels).query(pixels)
        there, row = distance_px < _SAME_PIXEL_PX, np.minimum(row, count - 1)
        seen = self.seen_depth
        return KeypointDepth(
            np.where(there, seen.disparity[row], np.nan),
            np.where(there[:, None], seen.slope[row], np.nan),
            np.where(there[:, None], seen.grid_pixels[row], np.nan),
            np.where(there, seen.sigma[row], np.nan),
        )

    def without_depth(self) -> "SyntheticCamera":
        """The same camera, whose depth camera delivers nothing."""
        count = len(self.keypoints)
        nothing = _no_depth(count)
        return replace(self, depth=nothing, points=np.full((count, 3), np.nan), seen_depth=nothing)


def _no_depth(count: int) -> KeypointDepth:
    nothing, nowhere = np.full(count, np.nan), np.full((count, 2), np.nan)
    return KeypointDepth(nothing, nowhere, nowhere, nothing)


@dataclass
class SyntheticRig:
    """A ring after a drawing, its mounting errors, and points around it."""

    cameras: int = 12
    points: int = 3000
    seed: int = 0
    mounting_deg: float = 1.0
    mounting_m: float = 0.005
    bias: float = 0.0
    drawing: RingDrawing = field(default_factory=RingDrawing)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        azimuth = rng.uniform(-np.pi, np.pi, self.points)
        radius = rng.uniform(1.2, 2.8, self.points)
        self.world = np.column_stack(
            [radius * np.cos(azimuth), radius * np.sin(azimuth), radius * rng.uniform(-0.6, 0.6, self.points)]
        )
        self.descriptors = rng.uniform(0, 60, (self.points, 128)).astype(np.float32)
        sigma = np.repeat([np.deg2rad(self.mounting_deg), self.mounting_m], 3)
        self.truth: dict[int, Pose] = {
            c: self.drawing.T_rig_camera(c) @ se3_exp(sigma * rng.standard_normal(6))
            for c in range(self.cameras)
        }
        self.depth_scale = 1.0 + self.bias * rng.standard_normal(self.cameras)

    def view(self, camera: int, drawn: bool = True) -> CameraView:
        """A view whose images hold nothing: `observe` stands in for them."""
        nominal = self.drawing.T_rig_camera(camera) if drawn else None
        return CameraView(camera, f"cam{camera:02d}", MODEL, (IMAGE,), raw=(NO_DEPTH,), T_rig_nominal=nominal)

    def views(self, drawn: bool = True) -> list[CameraView]:
        """Views of all cameras."""
        return [self.view(camera, drawn) for camera in range(self.cameras)]

    def observe(
        self,
        camera: int,
        pixel_sigma: float = 0.0,
        disparity_sigma: float = 0.0,
        seed: int = 0,
        only: Sequence[int] | npt.NDArray[np.intp] | None = None,
        drawn: bool = True,
    ) -> SyntheticCamera:
        """Keypoints of the points (or `only` some of them) that a camera sees, with noise."""
        rng = np.random.default_rng([seed, camera])
        numbers = np.arange(self.points) if only is None else np.asarray(only)
        seen = transform_points(inverse(self.truth[camera]), self.world[numbers])
        ahead = seen[:, 2] > 0.3
        numbers, seen = numbers[ahead], seen[ahead]
        pixels = project(COLOR, seen)
        visible = inside(COLOR, pixels, -1.0)
        numbers, seen, pixels = numbers[visible], seen[visible], pixels[visible]
        grid = depth_grid(MODEL, "depth")
        in_grid = transform_points(inverse(grid.T_color_grid), seen)
        measured_m = in_grid[:, 2] / self.depth_scale[camera]
        disparity = disparity_of_depth(grid.raw_model, measured_m)
        disparity = disparity + disparity_sigma * rng.standard_normal(len(disparity))
        pixels = pixels + pixel_sigma * rng.standard_normal(pixels.shape)
        depth = KeypointDepth(
            disparity,
            np.zeros((len(pixels), 2)),
            project(DEPTH, in_grid),
            np.full(len(pixels), max(disparity_sigma, 0.05)),
        )
        keypoints = Keypoints(
            pixels,
            np.broadcast_to(np.eye(2) / ASSUMED_SIGMA_PX**2, (len(pixels), 2, 2)),
            self.descriptors[numbers],
            np.arange(len(pixels)),
        )
        points = keypoint_points(COLOR, grid, pixels, depth)
        flat, nowhere = IMAGE.astype(np.float32), np.full(NO_DEPTH.shape, np.nan)
        view = self.view(camera, drawn)
        return SyntheticCamera(view, grid, flat, nowhere, keypoints, depth, points, pixels, depth)


def true_matches(a: ObservedCamera, b: ObservedCamera) -> npt.NDArray[np.intp]:
    """Matches (N,2) of keypoints with the same descriptor."""
    rows = {row.tobytes(): k for k, row in enumerate(b.keypoints.descriptors)}
    pairs = [(k, rows[d.tobytes()]) for k, d in enumerate(a.keypoints.descriptors) if d.tobytes() in rows]
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


def pose_distance(a: Pose, b: Pose) -> tuple[float, float]:
    """Degrees and millimetres between two poses."""
    T = inverse(a) @ b
    angle = np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1))
    return float(np.rad2deg(angle)), float(np.linalg.norm(T[:3, 3]) * 1e3)
