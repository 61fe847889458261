"""Rules of the virtual rig: deterministic frames, enough to match between neighbours, truth kept apart."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from rig_agent.simulator.lens import ray_grid
from rig_agent.simulator.ring import VirtualRig, rig_description, true_poses
from rig_agent.simulator.settings import Knock, SimulatorSettings
from rig_protocol.errors import ConfigurationError
from rig_protocol.frames import NO_DISPARITY
from rig_protocol.poses import inverse, transform_points
from rig_protocol.rig_folder import read_frame, read_rig_description, write_rig_folder

SETTINGS = SimulatorSettings(cameras=3, seed=11, blocked_overlaps=0)


@pytest.fixture(scope="module")
def rig() -> VirtualRig:
    return VirtualRig(SETTINGS)


def test_a_frame_depends_on_seed_camera_and_index_alone(rig: VirtualRig) -> None:
    here = [rig.camera(1).frame(k) for k in (0, 3)]
    elsewhere = VirtualRig(SETTINGS).camera(1)
    there = [elsewhere.frame(k) for k in (3, 0)][::-1]  # another process, another order
    for one, other in zip(here, there, strict=True):
        assert np.array_equal(one.bayer, other.bayer)  # type: ignore[arg-type]  # a virtual Kinect has both
        assert np.array_equal(one.raw, other.raw)  # type: ignore[arg-type]


def test_looped_frames_carry_fresh_noise_on_the_same_scene(rig: VirtualRig) -> None:
    first, second = (rig.camera(0).frame(k) for k in (0, 1))
    assert first.bayer is not None
    assert second.bayer is not None
    assert (first.bayer != second.bayer).mean() > 0.5
    assert abs(first.bayer.astype(int) - second.bayer).mean() < 5
    assert (first.sequence, second.sequence) == (0, 1)


def test_frames_rendered_repeats_noise_after_as_many_frames() -> None:
    kinect = VirtualRig(SETTINGS.model_copy(update={"frames_rendered": 2})).camera(0)
    assert kinect.frame(0).raw is kinect.frame(2).raw
    assert kinect.frame(0).raw is not kinect.frame(1).raw
    assert kinect.frame(5).sequence == 5


def test_measured_depth_is_true_depth_up_to_the_units_bias(rig: VirtualRig) -> None:
    kinect = rig.camera(0)
    raw = kinect.frame(0).raw
    assert raw is not None
    valid = raw != NO_DISPARITY
    assert valid.mean() > 0.85
    told = kinect.model.raw_model
    z_told = told.numerator_m / (told.offset - raw[valid].astype(np.float64))
    z_true = kinect.view().depth([]).z_m[valid]
    scale = told.numerator_m / kinect.unit.raw_model.numerator_m
    assert np.median(z_told / z_true) == pytest.approx(scale, abs=0.01)
    # Distortion of the unit: 34 mm peak to peak at 1.5 m, growing with distance to some 3 %.
    assert np.quantile(np.abs(z_told / z_true / scale - 1), 0.95) < 0.03


def test_shadows_lie_on_the_side_away_from_the_projector() -> None:
    # The projector is to the right of the depth camera, so it cannot see what is left of a near edge.
    rig = VirtualRig(SimulatorSettings(seed=0))
    shadows = [rig.camera(i).view().depth([]) for i in (4, 5)]
    left = right = 0
    for clean in shadows:
        rows, columns = np.nonzero(clean.shadow[:, 30:-30])
        columns = columns + 30
        left += int((clean.z_m[rows, columns - 30] < 0.9 * clean.z_m[rows, columns]).sum())
        right += int((clean.z_m[rows, columns + 30] < 0.9 * clean.z_m[rows, columns]).sum())
    assert right > 500
    assert right > 10 * left


def grey(rig: VirtualRig, camera: int) -> npt.NDArray[np.uint8]:
    bayer = rig.camera(camera).frame(0).bayer
    return np.asarray(cv2.cvtColor(bayer, cv2.COLOR_BayerGRBG2GRAY), dtype=np.uint8)  # type: ignore[arg-type]


def test_neighbours_share_hundreds_of_true_matches(rig: VirtualRig) -> None:
    sift = cv2.SIFT_create(nfeatures=2000)
    images = [grey(rig, 0)[300:], grey(rig, 1)[:180]]  # image +y points to the next camera of the ring
    (points_0, descriptors_0), (points_1, descriptors_1) = (sift.detectAndCompute(i, None) for i in images)
    matches = cv2.BFMatcher(crossCheck=True).match(descriptors_0, descriptors_1)
    seen_0 = np.array([points_0[m.queryIdx].pt for m in matches]) + np.array([0, 300])
    seen_1 = np.array([points_1[m.trainIdx].pt for m in matches])
    first, second = rig.camera(0), rig.camera(1)
    u, v = np.rint(seen_0).astype(int).T
    z, rays = first.view().color_z_m()[v, u].astype(np.float64), ray_grid(first.unit.color)
    points = np.stack([rays.x[v, u] * z, rays.y[v, u] * z, z], axis=-1)
    moved = transform_points(inverse(second.T_rig_camera) @ first.T_rig_camera, points)
    camera = second.unit.color
    expected = np.stack(
        [
            camera.fx * moved[:, 0] / moved[:, 2] + camera.cx,
            camera.fy * moved[:, 1] / moved[:, 2] + camera.cy,
        ],
        -1,
    )
    correct = np.linalg.norm(expected - seen_1, axis=1) < 3
    assert correct.sum() > 100
    assert correct.mean() > 0.5


def test_the_description_holds_the_drawing_and_factory_values_only(rig: VirtualRig) -> None:
    description = rig_description(SETTINGS)
    text = str(description.to_dict())
    for camera in description.cameras:
        truth = rig.camera(camera.id)
        assert camera.model.to_dict() == truth.model.to_dict()
        assert camera.T_rig_camera is not None
        assert not np.allclose(camera.T_rig_camera, truth.T_rig_camera, atol=1e-4)
        assert repr(truth.unit.color.fx) not in text
        assert repr(truth.unit.raw_model.numerator_m) not in text


def test_true_poses_are_those_of_the_cameras(rig: VirtualRig) -> None:
    for camera, T in true_poses(SETTINGS).items():
        assert np.array_equal(T, rig.camera(camera).T_rig_camera)


def test_a_simulated_capture_can_be_written_as_a_rig_folder(rig: VirtualRig, tmp_path: Path) -> None:
    frame = rig.camera(1).frame(2)
    write_rig_folder(tmp_path, rig_description(SETTINGS), [frame])
    read = read_frame(tmp_path, read_rig_description(tmp_path).camera(1), 2)
    assert np.array_equal(read.raw, frame.raw)  # type: ignore[arg-type]


def test_a_depthless_camera_delivers_colour_only() -> None:
    rig = VirtualRig(SETTINGS.model_copy(update={"depthless_camera": 0}))
    frame = rig.camera(0).frame(0)
    assert frame.raw is None
    assert frame.bayer is not None


def test_a_knocked_camera_sees_the_room_from_elsewhere() -> None:
    rig = VirtualRig(SETTINGS.model_copy(update={"knock": Knock(camera=0, from_frame=1)}))
    before, after = (rig.camera(0).frame(k).bayer for k in (0, 1))
    assert before is not None
    assert after is not None
    assert np.abs(before.astype(int) - after).mean() > 10


def test_a_camera_outside_the_ring_is_named(rig: VirtualRig) -> None:
    with pytest.raises(ConfigurationError, match="camera 3 is not in the simulated ring, which has 0 to 2"):
        rig.camera(3)
