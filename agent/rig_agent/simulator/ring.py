"""The virtual rig: a ring of virtual Kinects in one room, and what its user knows of it."""

from functools import cached_property

from rig_agent.simulator.kinect import VirtualKinect
from rig_agent.simulator.scene import Scene, build_scene
from rig_agent.simulator.settings import SimulatorSettings
from rig_agent.simulator.units import draw_T_rig_camera, draw_unit, ring_drawing
from rig_protocol.errors import ConfigurationError
from rig_protocol.poses import Pose
from rig_protocol.rig_folder import CameraEntry, RigDescription


class VirtualRig:
    """Virtual Kinects of one room; a camera costs nothing before its first frame."""

    def __init__(self, settings: SimulatorSettings) -> None:
        """The same settings make the same rig in every process."""
        self.settings = settings
        self._cameras: dict[int, VirtualKinect] = {}

    @cached_property
    def scene(self) -> Scene:
        """The room."""
        return build_scene(self.settings)

    def camera(self, camera: int) -> VirtualKinect:
        """The Kinect in a slot; ConfigurationError when the ring has no such slot."""
        if not 0 <= camera < self.settings.cameras:
            raise ConfigurationError(
                f"camera {camera} is not in the simulated ring, which has 0 to {self.settings.cameras - 1}"
            )
        if camera not in self._cameras:
            self._cameras[camera] = VirtualKinect(self.settings, self.scene, camera)
        return self._cameras[camera]


def rig_description(settings: SimulatorSettings) -> RigDescription:
    """What the user of the simulated rig knows: the drawing, nominal poses, factory models."""
    drawing = ring_drawing(settings)
    cameras = tuple(
        CameraEntry(i, f"cam{i:02d}", draw_unit(settings, i).factory, drawing.T_rig_camera(i))
        for i in range(settings.cameras)
    )
    return RigDescription(cameras, drawing)


def true_poses(settings: SimulatorSettings) -> dict[int, Pose]:
    """True T_rig_camera by camera id, in the frame of the drawing: the content of `truth.json`."""
    return {i: draw_T_rig_camera(settings, i) for i in range(settings.cameras)}
