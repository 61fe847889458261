"""One virtual Kinect of the ring: its factory model, its true pose, its frames."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import numpy.typing as npt

from rig_agent.simulator.accelerometer import felt_acceleration
from rig_agent.simulator.color_sensor import BayerSensor
from rig_agent.simulator.foreground import PROJECTOR_BASELINE_M, LampLight, color_patches, depth_patches
from rig_agent.simulator.kinect_noise import CleanDepth, DisparitySensor, Mask
from rig_agent.simulator.lens import Plane, RayGrid, ray_grid
from rig_agent.simulator.people import People, Standing
from rig_agent.simulator.renderer import Hits, cast, cosine_of_incidence, shade
from rig_agent.simulator.scene import Scene
from rig_agent.simulator.settings import SimulatorSettings
from rig_agent.simulator.streams import Stream, generator
from rig_agent.simulator.units import VirtualUnit, draw_T_rig_camera, draw_unit
from rig_protocol.camera import CameraModel, Intrinsics
from rig_protocol.frames import ImageU8, ImageU16, RgbdFrame
from rig_protocol.gravity import Gravity
from rig_protocol.poses import Pose, inverse, transform_points

Images = tuple[ImageU8, ImageU16 | None]

COLOR_SAMPLES = 2
"""Rays a pixel and axis of the colour image."""

_PROJECTOR = Intrinsics(580.0, 580.0, 340.0, 260.0, 680, 520)
_SHADOW_TOLERANCE = 0.02  # relative depth by which a blocker must be nearer than what it shades
_PROJECTOR_REACH = (0.57, 0.43)  # tangents of half its field


class View:
    """What one unit sees of a scene from one place; rendered when first asked for."""

    def __init__(self, scene: Scene, unit: VirtualUnit, T_rig_camera: Pose) -> None:
        """`T_rig_camera` is the pose of the colour camera."""
        self.scene, self.unit = scene, unit
        self.T_room_color = np.asarray(scene.T_room_rig @ T_rig_camera)
        self.T_room_depth = np.asarray(self.T_room_color @ unit.T_color_depth)

    def color(self) -> ImageU8:
        """BGR with COLOR_SAMPLES² points a pixel, without noise."""
        rays = ray_grid(self.unit.color, COLOR_SAMPLES)
        hits = cast(self.scene.surfaces, self.T_room_color, rays)
        return shade(self.scene, hits, self.T_room_color, rays)

    def color_z_m(self) -> Plane:
        """True depth (rows, columns) at the colour camera's pixels, 0 where nothing is."""
        return _depth(cast(self.scene.surfaces, self.T_room_color, ray_grid(self.unit.color)))

    def depth(self, projectors: list[Pose]) -> CleanDepth:
        """True depth and what keeps a Kinect from measuring it; `projectors`: poses of the neighbours'."""
        rays = ray_grid(self.unit.depth)
        hits = cast(self.scene.surfaces, self.T_room_depth, rays)
        z_m = _depth(hits)
        points = np.stack([rays.x * z_m, rays.y * z_m, z_m], axis=-1).reshape(-1, 3).astype(np.float64)
        interfered = np.zeros(len(points), bool)
        for T_room_projector in projectors:
            interfered |= _lit(transform_points(inverse(T_room_projector) @ self.T_room_depth, points))
        return CleanDepth(
            z_m,
            cosine_of_incidence(self.scene.surfaces, hits, self.T_room_depth, rays),
            self._shadow(rays, z_m),
            interfered.reshape(z_m.shape),
        )

    def _shadow(self, rays: RayGrid, z_m: Plane) -> Mask:
        """Pixels whose surface the projector does not reach: something is nearer to it on the same ray."""
        T_room_projector = projector_pose(self.T_room_depth)
        lit_z = _depth(cast(self.scene.surfaces, T_room_projector, ray_grid(_PROJECTOR)))
        z = np.maximum(z_m, 1e-3)
        column = _PROJECTOR.fx * (rays.x - PROJECTOR_BASELINE_M / z) + _PROJECTOR.cx
        row = _PROJECTOR.fy * rays.y + _PROJECTOR.cy
        nearest = lit_z[
            np.clip(np.rint(row), 0, _PROJECTOR.height - 1).astype(int),
            np.clip(np.rint(column), 0, _PROJECTOR.width - 1).astype(int),
        ]
        return np.asarray(nearest < z_m * (1 - _SHADOW_TOLERANCE))


class Sensors:
    """Both sensors of a unit at one place in the still room, and what people change in their images."""

    def __init__(self, view: View, color: BayerSensor, depth: DisparitySensor | None) -> None:
        self.view, self.color, self.depth = view, color, depth

    def images(self, rng: np.random.Generator, people: Sequence[Standing] = ()) -> Images:
        """One frame of each; None where the unit measures no depth."""
        if not people:
            return self.color.frame(rng), None if self.depth is None else self.depth.frame(rng)
        view = self.view
        covers = color_patches(view.scene, people, view.T_room_color, self._color_rays, COLOR_SAMPLES)
        color = self.color.frame(rng, self._lamp.left_by(people), covers)
        if self.depth is None:
            return color, None
        projector = projector_pose(view.T_room_depth)
        patches = depth_patches(self.depth.clean, people, view.T_room_depth, self._depth_rays, projector)
        return color, self.depth.frame(rng, patches)

    @cached_property
    def _color_rays(self) -> RayGrid:
        return ray_grid(self.view.unit.color, COLOR_SAMPLES)

    @cached_property
    def _depth_rays(self) -> RayGrid:
        return ray_grid(self.view.unit.depth)

    @cached_property
    def _lamp(self) -> LampLight:
        return LampLight.on(self.view.scene, self.view.unit.color, self.view.T_room_color)


class VirtualKinect:
    """A camera of the ring. Frames are a function of (settings, camera, k) alone."""

    def __init__(self, settings: SimulatorSettings, scene: Scene, camera: int) -> None:
        """Nothing is rendered before a frame is asked for."""
        self.id = camera
        self._settings, self._scene = settings, scene
        self._people = People(settings, scene)
        self._rendered: dict[bool, Sensors] = {}
        self._loop: dict[tuple[bool, int], Images] = {}

    @cached_property
    def unit(self) -> VirtualUnit:
        """The truth about the unit in this slot."""
        return draw_unit(self._settings, self.id)

    @property
    def model(self) -> CameraModel:
        """What the unit's factory says: all that a hello may tell."""
        return self.unit.factory

    @property
    def serial(self) -> str:
        """A made-up serial, the same for the same seed and slot."""
        return f"SIM{self._settings.seed % 10**6:06d}{self.id:03d}"

    @property
    def T_rig_camera(self) -> Pose:
        """True pose of the colour camera in the frame of the ring's drawing, at frame 0."""
        return self.T_rig_camera_at(0)

    def T_rig_camera_at(self, frame: int) -> Pose:
        """True pose when a frame is taken."""
        return draw_T_rig_camera(self._settings, self.id, frame)

    @property
    def frame_interval_ns(self) -> int:
        """Time between frames."""
        return round(1e9 / self._settings.fps)

    @cached_property
    def phase_ns(self) -> int:
        """When frame 0 is taken: cameras run freely, so phases are independent."""
        rng = generator(self._settings.seed, Stream.PHASE, self.id)
        return int(rng.integers(self.frame_interval_ns))

    def view(self, frame: int = 0) -> View:
        """What is seen, without the sensor's errors, when a frame is taken."""
        return View(self._scene, self.unit, self.T_rig_camera_at(frame))

    def gravity(self, k: int) -> Gravity | None:
        """Down as the unit feels it when frame k is taken; None without accelerometers."""
        if not self._settings.accelerometers:
            return None
        R_room_color = (self._scene.T_room_rig @ self.T_rig_camera_at(k))[:3, :3]
        felt_g = felt_acceleration(self._settings, self.id, self._moment(k), -R_room_color[2])
        return Gravity.along(felt_g)

    def frame(self, k: int) -> RgbdFrame:
        """Frame k, stamped as if frame 0 was taken at `phase_ns`; all repeats after `frames_rendered`."""
        moment = self._moment(k)
        images = self._looped(k, moment) if self._settings.frames_rendered else self._images(k, moment)
        return RgbdFrame(
            camera_id=self.id,
            sequence=k,
            timestamp_ns=self.phase_ns + k * self.frame_interval_ns,
            bayer=images[0],
            raw=images[1],
            gravity=self.gravity(k),
        )

    def _moment(self, k: int) -> int:
        """The frame whose people and noise frame k shows."""
        loop = self._settings.frames_rendered
        return k % loop if loop else k

    def _looped(self, k: int, moment: int) -> Images:
        key = (self._knocked(k), moment)
        if key not in self._loop:
            self._loop[key] = self._images(k, moment)
        return self._loop[key]

    def _images(self, k: int, moment: int) -> Images:
        """What is seen from the place of frame k, with the people and the noise of the frame `moment`."""
        rng = generator(self._settings.seed, Stream.FRAME, self.id, moment)
        time_ns = self.phase_ns + moment * self.frame_interval_ns
        return self._sensors(k).images(rng, self._people.at(time_ns / 1e9))

    def _sensors(self, k: int) -> Sensors:
        """Both sensors in front of the scene as it is seen at frame k; rendered once a place."""
        knocked = self._knocked(k)
        if knocked not in self._rendered:
            self._rendered[knocked] = self._render(self.view(k), k)
        return self._rendered[knocked]

    def _render(self, view: View, k: int) -> Sensors:
        settings = self._settings
        rng = generator(settings.seed, Stream.FIXED_NOISE, self.id)
        color = BayerSensor(rng, view.color(), COLOR_SAMPLES, self.unit.exposure)
        if settings.depthless_camera == self.id:
            return Sensors(view, color, None)
        clean = view.depth(self._neighbouring_projectors(k))
        return Sensors(view, color, DisparitySensor(rng, clean, self.unit.raw_model, settings))

    def _knocked(self, k: int) -> bool:
        knock = self._settings.knock
        return knock is not None and knock.camera == self.id and k >= knock.from_frame

    def _neighbouring_projectors(self, k: int) -> list[Pose]:
        neighbours = {i for pair in self._settings.overlaps if self.id in pair for i in pair} - {self.id}
        return [
            projector_pose(
                self._scene.T_room_rig
                @ draw_T_rig_camera(self._settings, i, k)
                @ draw_unit(self._settings, i).T_color_depth
            )
            for i in sorted(neighbours)
        ]


def projector_pose(T_room_depth: Pose) -> Pose:
    """T_room_projector of the unit whose depth camera is at T_room_depth."""
    T = T_room_depth.copy()
    T[:3, 3] += PROJECTOR_BASELINE_M * T[:3, 0]
    return T


def _depth(hits: Hits) -> Plane:
    seen = hits.inverse_z > 0
    return np.asarray(np.where(seen, 1 / np.where(seen, hits.inverse_z, 1), 0), dtype=np.float32)


def _lit(points: npt.NDArray[np.float64]) -> Mask:
    """Which points (N,3) in a projector's frame lie in its field."""
    x, y, z = points.T
    return np.asarray((z > 0) & (np.abs(x) < _PROJECTOR_REACH[0] * z) & (np.abs(y) < _PROJECTOR_REACH[1] * z))
