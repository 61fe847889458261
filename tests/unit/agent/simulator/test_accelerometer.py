"""The virtual Kinect's accelerometer: honest errors, which cost nothing else of the simulation."""

import numpy as np
import pytest

from rig_agent.simulator.ring import VirtualRig
from rig_agent.simulator.settings import Knock, SimulatorSettings
from rig_protocol.gravity import KINECT_SIGMA_DEG, Gravity

DOWN_IN_RIG = np.array([0.0, 0.0, -1.0])


def felt(rig: VirtualRig, camera: int, k: int = 0) -> Gravity:
    gravity = rig.camera(camera).gravity(k)
    assert gravity is not None
    return gravity


def error_deg(rig: VirtualRig, camera: int, k: int = 0) -> float:
    """Angle between what is felt and the truth."""
    truth = rig.camera(camera).T_rig_camera_at(k)[:3, :3].T @ DOWN_IN_RIG
    return float(np.rad2deg(np.arccos(np.clip(np.array(felt(rig, camera, k).down) @ truth, -1, 1))))


def test_units_err_as_much_as_they_tell() -> None:
    """Two axes of σ: the mean square of the angle is 2σ²."""
    errors = [error_deg(VirtualRig(SimulatorSettings(seed=s)), c) for s in range(25) for c in range(12)]
    assert np.sqrt(np.mean(np.square(errors)) / 2) == pytest.approx(KINECT_SIGMA_DEG, rel=0.1)


def test_a_unit_errs_alike_all_the_time_but_for_a_little_noise() -> None:
    rig = VirtualRig(SimulatorSettings(seed=4))
    downs = np.array([felt(rig, 3, k).down for k in range(50)])
    scatter_deg = np.rad2deg(downs.std(axis=0).max())
    assert 0.01 < scatter_deg < 0.2


def test_without_errors_down_is_true_also_for_a_camera_that_was_knocked() -> None:
    knock = Knock(camera=1, deg=10.0, from_frame=2)
    settings = SimulatorSettings(cameras=3, accelerometer_deg=0.0, knock=knock)
    rig = VirtualRig(settings)
    assert max(error_deg(rig, 1, k) for k in (0, 2)) < 0.5  # noise and scale are left
    assert not np.allclose(felt(rig, 1, 0).down, felt(rig, 1, 2).down, atol=0.01)


def test_frames_carry_what_was_felt_and_it_repeats_with_them() -> None:
    rig = VirtualRig(SimulatorSettings(cameras=2, frames_rendered=2))
    kinect = rig.camera(1)
    assert kinect.frame(1).gravity == kinect.gravity(1)
    assert kinect.gravity(3) == kinect.gravity(1) != kinect.gravity(0)


def test_accelerometers_change_nothing_but_what_is_felt() -> None:
    settings = SimulatorSettings(cameras=2, seed=7)
    kinect = VirtualRig(settings).camera(0)
    without = VirtualRig(settings.model_copy(update={"accelerometers": False})).camera(0)
    one, other = kinect.frame(3), without.frame(3)
    assert one.gravity is not None
    assert other.gravity is None
    np.testing.assert_array_equal(one.bayer, other.bayer)
    np.testing.assert_array_equal(one.raw, other.raw)
    np.testing.assert_array_equal(kinect.T_rig_camera, without.T_rig_camera)
