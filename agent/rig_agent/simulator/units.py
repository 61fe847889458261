"""What one Kinect is really like, what its factory says, and where it was really screwed on."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rig_agent.simulator.settings import SimulatorSettings
from rig_agent.simulator.streams import Stream, generator
from rig_protocol.camera import CameraModel, Intrinsics, RawDepthModel
from rig_protocol.poses import Pose, se3_exp
from rig_protocol.rig_folder import RingDrawing

Vector = npt.NDArray[np.float64]

_FOCAL_ERROR, _CENTRE_ERROR_PX = 0.001, 0.6
_ROTATION_ERROR_RAD, _TRANSLATION_ERROR_M = np.deg2rad(0.04), 0.0005


@dataclass(frozen=True, slots=True, eq=False)
class VirtualUnit:
    """One Kinect: the model that it tells, the model that is true, and its exposure factor."""

    factory: CameraModel
    color: Intrinsics
    depth: Intrinsics
    T_color_depth: Pose
    raw_model: RawDepthModel
    exposure: float


def draw_unit(settings: SimulatorSettings, camera: int) -> VirtualUnit:
    """The unit in a slot: factory values drawn around typical ones, true values around the factory's."""
    rng = generator(settings.seed, Stream.UNIT, camera)
    told_k1 = settings.lens_k1 * rng.standard_normal()
    color = _draw_camera(rng, 525.0, (320.0, 244.0), told_k1)
    depth = _draw_camera(rng, 580.0, (318.0, 242.0), 0.0)
    T = se3_exp(np.concatenate([np.deg2rad(0.4) * rng.standard_normal(3), 0.0004 * rng.standard_normal(3)]))
    T[0, 3] -= 0.025
    factory = CameraModel(color, depth, T, RawDepthModel(), source="factory")
    errors = np.repeat([_ROTATION_ERROR_RAD, _TRANSLATION_ERROR_M], 3) * rng.standard_normal(6)
    scale = 1 + settings.depth_bias * rng.standard_normal()
    return VirtualUnit(
        factory=factory,
        color=_spoil(rng, color, settings),
        depth=_spoil(rng, depth, settings),
        T_color_depth=T @ se3_exp(settings.factory_error * errors),
        raw_model=RawDepthModel(factory.raw_model.numerator_m * scale, factory.raw_model.offset),
        exposure=float(np.exp(settings.exposure_spread * rng.standard_normal())),
    )


def ring_drawing(settings: SimulatorSettings) -> RingDrawing:
    """The drawing after which the simulated ring was built, with its true tolerances."""
    return RingDrawing(
        settings.ring_radius_m,
        settings.yaw_step_deg,
        # A tolerance of nothing would divide by zero in whoever weighs the drawing.
        max(settings.mounting_deg, 1e-3),
        max(settings.mounting_m, 1e-6),
    )


def draw_T_rig_camera(settings: SimulatorSettings, camera: int, frame: int = 0) -> Pose:
    """True pose of a slot's colour camera when a frame is taken."""
    drawn = generator(settings.seed, Stream.MOUNT, camera).standard_normal(6)
    sigma = np.repeat([np.deg2rad(settings.mounting_deg), settings.mounting_m], 3)
    T = ring_drawing(settings).T_rig_camera(camera) @ se3_exp(sigma * drawn)
    knock = settings.knock
    if knock is None or knock.camera != camera or frame < knock.from_frame:
        return np.asarray(T)
    direction = generator(settings.seed, Stream.KNOCK, camera).standard_normal((2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray(
        T @ se3_exp(np.concatenate([np.deg2rad(knock.deg) * direction[0], knock.m * direction[1]]))
    )


def _draw_camera(
    rng: np.random.Generator, focal: float, centre: tuple[float, float], k1: float
) -> Intrinsics:
    fx = focal + 3 * rng.standard_normal()
    fy = fx + 0.1 * rng.standard_normal()
    cx, cy = np.array(centre) + 2 * rng.standard_normal(2)
    return Intrinsics(fx, fy, float(cx), float(cy), dist=(k1, 0, 0, 0, 0))


def _spoil(rng: np.random.Generator, told: Intrinsics, settings: SimulatorSettings) -> Intrinsics:
    """The true camera behind the told one."""
    focal, cx, cy, k1 = rng.standard_normal(4)
    scale = 1 + _FOCAL_ERROR * settings.factory_error * focal
    return replace(
        told,
        fx=told.fx * scale,
        fy=told.fy * scale,
        cx=told.cx + _CENTRE_ERROR_PX * settings.factory_error * cx,
        cy=told.cy + _CENTRE_ERROR_PX * settings.factory_error * cy,
        dist=(told.dist[0] + settings.lens_residual_k1 * k1, 0.0, 0.0, 0.0, 0.0),
    )
