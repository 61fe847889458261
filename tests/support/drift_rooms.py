"""Rendered rooms for the drift watch: looks of a virtual ring, and a calibration as it usually is."""

from collections.abc import Iterator

import numpy as np

from rig_agent.simulator.kinect import VirtualKinect
from rig_agent.simulator.ring import VirtualRig
from rig_agent.simulator.settings import Knock, SimulatorSettings
from rig_calib.drift.frame_looks import look_of_frame
from rig_calib.drift.look import Look
from rig_calib.drift.reference import CameraKnown
from rig_calib.drift.watch import DriftWatch
from rig_protocol.poses import Pose, se3_exp

EVERY = 4  # as the server does by default
LEARNT_FRAMES = 12 * EVERY
_SIGMA_DEG, _SIGMA_MM = 0.06, 2.0  # of each axis of a camera's pose, as docs/calibration.md measures it


class DriftRoom:
    """A ring in a room without patterns, and a watch that has learnt it."""

    def __init__(self, seed: int, people: int, cameras: int = 12) -> None:
        self.settings = SimulatorSettings(seed=seed, people=people, cameras=cameras, patterns=False)
        self.rig = VirtualRig(self.settings)
        self.kinects = {k: self.rig.camera(k) for k in range(cameras)}

    def calibrated_poses(self) -> dict[int, Pose]:
        """True poses with a calibration's errors."""
        rng = np.random.default_rng(self.settings.seed)
        sigma = np.repeat([np.deg2rad(_SIGMA_DEG), _SIGMA_MM / 1e3], 3)
        return {
            k: kinect.T_rig_camera @ se3_exp(sigma * rng.standard_normal(6))
            for k, kinect in self.kinects.items()
        }

    def watch(self) -> DriftWatch:
        """A watch that has seen nothing yet."""
        watch = DriftWatch(self.calibrated_poses())
        for k, kinect in self.kinects.items():
            watch.add_camera(k, CameraKnown(kinect.model))
        return watch

    def looks(self, frame: int) -> dict[int, Look]:
        """Of all cameras."""
        return {k: look_of(kinect, frame) for k, kinect in self.kinects.items()}

    def knocked(self, camera: int, deg: float, mm: float, from_frame: int) -> VirtualKinect:
        """The same camera when somebody bumps into it."""
        knock = Knock(camera=camera, deg=deg, m=mm / 1e3, from_frame=from_frame)
        return VirtualKinect(self.settings.model_copy(update={"knock": knock}), self.rig.scene, camera)


def look_of(kinect: VirtualKinect, frame: int) -> Look:
    """One camera's look at a frame."""
    look = look_of_frame(kinect.model, kinect.frame(frame))
    assert look is not None
    return look


def watched_frames(first: int, end: int) -> Iterator[int]:
    """The frames that are looked at."""
    return iter(range(first, end, EVERY))
