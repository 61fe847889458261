"""The joint estimate: all poses, points and depth-bias states of observed cameras in one adjustment."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from rig_calib.bundle_adjustment import CONVERGED, AdjustedCamera, Adjustment, adjust
from rig_calib.depth_model import DepthCorrection, DepthGrid, depth_basis
from rig_calib.matching import Matches
from rig_calib.noise import NoiseModel, observed_noise
from rig_calib.observation_model import GRID_INTRINSIC_TERMS, GRID_POSE_TERMS, CameraState
from rig_calib.observed_camera import ObservedCamera
from rig_calib.projection import from_pixels
from rig_calib.settings import CalibrationSettings
from rig_calib.shared_planes import NOTHING_SHARED, SharedPlanes
from rig_calib.tracks import Scene, build_scene, build_tracks
from rig_calib.uncertainty import PoseCovariance, pose_covariance
from rig_calib.view import CameraView
from rig_protocol.camera import ModelSource
from rig_protocol.poses import Pose, inverse
from rig_protocol.rig_folder import RingDrawing

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ModelSigma:
    """How far a camera model may be off, as standard deviations; focal lengths as shares.

    `grid_*` are the depth camera's, where depth comes on its own grid.
    """

    focal: float
    centre_px: float
    k1: float
    grid_turn_deg: float
    grid_shift_m: float
    grid_focal: float
    grid_centre_px: float

    @property
    def intrinsics(self) -> Array:
        """Of `CameraState.intrinsics`."""
        return np.array([self.focal, self.centre_px, self.centre_px, self.k1])

    @property
    def grid_pose(self) -> Array:
        """Of `CameraState.grid_pose`."""
        return np.repeat([np.deg2rad(self.grid_turn_deg), self.grid_shift_m], 3)

    @property
    def grid_intrinsics(self) -> Array:
        """Of `CameraState.grid_intrinsics`."""
        return np.array([self.grid_focal, self.grid_centre_px, self.grid_centre_px])


# Units differ from the common default by a percent, several pixels, and their lens's distortion.
_MEASURED = ModelSigma(0.001, 0.6, 0.001, 0.04, 0.0005, 0.001, 0.6)
_MODEL_SIGMA: Mapping[ModelSource, ModelSigma] = {
    "factory": _MEASURED,
    "file": _MEASURED,
    "default": ModelSigma(0.01, 5.0, 0.1, 0.5, 0.003, 0.01, 5.0),
}
AT_REST = NoiseModel()


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedRig:
    """Poses and depth corrections by camera id, with the joint covariance of the poses."""

    poses: Mapping[int, Pose]
    corrections: Mapping[int, DepthCorrection | None]
    covariance: PoseCovariance
    scene: Scene
    adjustment: Adjustment
    noise: NoiseModel

    @property
    def states(self) -> dict[int, CameraState]:
        """What was estimated of every camera, by id."""
        return dict(zip(self.scene.cameras, self.adjustment.states, strict=True))

    def covariance_of(self, camera_id: int) -> Array:
        """Covariance (6,6) of one camera's pose in the adjustment's frame."""
        return self.covariance.of(self.scene.cameras.index(camera_id))

    def joint_covariance(self, camera_ids: Sequence[int]) -> Array:
        """Covariance (6N,6N) of N cameras' poses in the adjustment's frame, in the order of their ids."""
        rows = [self.scene.cameras.index(camera_id) for camera_id in camera_ids]
        blocks = self.covariance.blocks[rows][:, :, rows]
        return np.ascontiguousarray(blocks.reshape(6 * len(rows), 6 * len(rows)))

    def aligned_covariances(self) -> dict[int, Array]:
        """Covariance (6,6) of every camera's pose without the common turn and shift of the rig, by id."""
        order = self.scene.cameras
        aligned = self.covariance.aligned([self.poses[c] for c in order])
        return {camera_id: aligned.of(k) for k, camera_id in enumerate(order)}

    def observed_noise(self) -> NoiseModel:
        """How noisy the capture turned out to be."""
        return observed_noise(self.scene.observations, self.adjustment.residuals)

    def relative(self, i: int, j: int) -> tuple[Pose, Array]:
        """T_i_j and its covariance (6,6)."""
        T_i_j = inverse(self.poses[i]) @ self.poses[j]
        order = self.scene.cameras
        return T_i_j, self.covariance.relative(order.index(i), order.index(j), T_i_j)


def adjust_rig(
    cameras: Mapping[int, ObservedCamera],
    matches: Mapping[tuple[int, int], Matches],
    poses: Mapping[int, Pose],
    ring: RingDrawing | None,
    settings: CalibrationSettings,
    noise: NoiseModel = AT_REST,
    states: Mapping[int, CameraState] = MappingProxyType({}),
    shared: SharedPlanes = NOTHING_SHARED,
    converged: float = CONVERGED,
) -> AdjustedRig:
    """Adjust the cameras that have a start in `poses` from matches that are believed.

    With a `ring` the drawing's poses and tolerance are a prior and define the frame; without one the
    first camera does. What `states` say beside the poses is where these start; where is none, at the factory
    models.
    """
    tracks = build_tracks(cameras, {pair: rows for pair, rows in matches.items() if set(pair) <= set(poses)})
    scene = build_scene(cameras, tracks, poses, noise)
    drawn = ring is not None and any(cameras[c].view.T_rig_nominal is not None for c in poses)
    adjusted = [
        _adjusted_camera(
            cameras[c],
            _start(poses[c], states.get(c), settings),
            ring if drawn else None,
            not drawn and c == scene.cameras[0],
            settings,
        )
        for c in scene.cameras
    ]
    result = adjust(
        adjusted, scene.points, scene.observations, shared.planes, shared.seen, converged=converged
    )
    states = dict(zip(scene.cameras, result.states, strict=True))
    return AdjustedRig(
        poses={c: state.T_rig_camera for c, state in states.items()},
        corrections={c: _correction(state) for c, state in states.items()},
        covariance=pose_covariance(result, adjusted),
        scene=scene,
        adjustment=result,
        noise=noise,
    )


def model_sigmas(view: CameraView) -> tuple[Array, Array, Array]:
    """How far a view's models may be off: `AdjustedCamera`'s sigmas but those of pose and depth bias."""
    sigma = _MODEL_SIGMA[view.model.source]
    if view.depth_frame == "color":  # depth has no camera of its own
        return sigma.intrinsics, np.zeros(GRID_POSE_TERMS), np.zeros(GRID_INTRINSIC_TERMS)
    return sigma.intrinsics, sigma.grid_pose, sigma.grid_intrinsics


def _start(T_rig_camera: Pose, known: CameraState | None, settings: CalibrationSettings) -> CameraState:
    if known is None:
        return CameraState(T_rig_camera, np.zeros(settings.bias_terms))
    return replace(known, T_rig_camera=T_rig_camera)


def _adjusted_camera(
    camera: ObservedCamera,
    start: CameraState,
    ring: RingDrawing | None,
    fixed: bool,
    settings: CalibrationSettings,
) -> AdjustedCamera:
    model = camera.view.model
    pose_sigma = None
    if ring is not None:
        pose_sigma = np.repeat([np.deg2rad(ring.tolerance_deg), ring.tolerance_m], 3)
    intrinsics_sigma, grid_pose_sigma, grid_intrinsics_sigma = model_sigmas(camera.view)
    return AdjustedCamera(
        color=model.color,
        grid=camera.grid,
        start=start,
        bias_sigma=bias_sigma(camera.grid, settings),
        intrinsics_sigma=intrinsics_sigma,
        grid_pose_sigma=grid_pose_sigma,
        grid_intrinsics_sigma=grid_intrinsics_sigma,
        T_prior=None if ring is None else camera.view.T_rig_nominal,
        pose_sigma=pose_sigma,
        fixed_pose=fixed,
        gravity=camera.view.gravity,
        gravity_sigma=float(np.deg2rad(camera.view.gravity_sigma_deg)),
    )


def bias_sigma(grid: DepthGrid, settings: CalibrationSettings) -> Array:
    """Prior standard deviations of the bias terms: the scale's, and shapes of one height over the image."""
    across = np.linspace(0, grid.intrinsics.width - 1, 3), np.linspace(0, grid.intrinsics.height - 1, 3)
    x, y = from_pixels(grid.intrinsics, np.stack(np.meshgrid(*across), axis=-1).reshape(-1, 2)).T
    shapes = depth_basis(x, y, max(settings.bias_terms, 1))[:, 1:]
    sigma = settings.bias_shape_sigma / np.ptp(shapes, axis=0)
    return np.concatenate([[settings.bias_scale_sigma], sigma])[: settings.bias_terms]


def _correction(state: CameraState) -> DepthCorrection | None:
    return DepthCorrection(tuple(state.bias.tolist())) if len(state.bias) else None
