"""Rules of the drift watch on rendered rooms without patterns: what is seen, named, and left in peace."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from rig_agent.simulator.kinect import VirtualKinect
from rig_agent.simulator.ring import rig_description
from rig_calib.depth_model import DepthGrid
from rig_calib.drift.depth_blocks import DepthBlocks
from rig_calib.drift.look import Look, known_disparity, look_at, mean_look, median_look
from rig_calib.drift.own_motion import compare
from rig_calib.drift.reference import CameraKnown, Reference, learn_reference
from rig_calib.drift.relocation import relocate
from rig_calib.drift.rig_watch import check
from rig_calib.drift.watch import DriftWatch
from rig_calib.projection import pixel_rays
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.camera import DEFAULT_DEPTH, RawDepthModel
from rig_protocol.frames import NO_DISPARITY, PanoramicFrame
from rig_protocol.poses import inverse, se3_exp, se3_log
from support.box_room import calibration_of
from support.drift_rooms import LEARNT_FRAMES, DriftRoom, look_of, watched_frames

BUMP_FRAME, END = LEARNT_FRAMES + 4, LEARNT_FRAMES + 64
MIDDLE = 1  # of an arc of three
UNITS = np.repeat([180 / np.pi, 1e3], 3)  # rad, m -> degrees, mm


@pytest.fixture(scope="module")
def room() -> DriftRoom:
    return DriftRoom(seed=8, people=1, cameras=3)


@pytest.fixture(scope="module")
def looks(room: DriftRoom) -> dict[int, dict[int, Look]]:
    return {frame: room.looks(frame) for frame in watched_frames(0, END)}


@pytest.fixture(scope="module")
def learnt(room: DriftRoom, looks: dict[int, dict[int, Look]]) -> DriftWatch:
    watch = room.watch()
    for frame in watched_frames(0, BUMP_FRAME):
        watch.take(looks[frame])
    return watch


@pytest.fixture(scope="module")
def reference(room: DriftRoom, looks: dict[int, dict[int, Look]]) -> Reference:
    known = CameraKnown(room.kinects[MIDDLE].model)
    return learn_reference(known, [looks[frame][MIDDLE] for frame in watched_frames(0, LEARNT_FRAMES)])


def true_motion(kinect: VirtualKinect) -> np.ndarray:
    return se3_log(inverse(kinect.T_rig_camera_at(0)) @ kinect.T_rig_camera_at(BUMP_FRAME))


@pytest.mark.parametrize(("deg", "mm"), [(0.5, 0.0), (0.0, 5.0)])
def test_a_bump_is_told_within_sixty_frames_and_the_camera_named(
    room: DriftRoom, looks: dict[int, dict[int, Look]], learnt: DriftWatch, deg: float, mm: float
) -> None:
    kinect, watch = room.knocked(MIDDLE, deg, mm, BUMP_FRAME), copy.deepcopy(learnt)
    for frame in watched_frames(BUMP_FRAME, BUMP_FRAME + 60):
        watch.take(looks[frame] | {MIDDLE: look_of(kinect, frame)})
    (moved,) = watch.status().moved
    assert moved.camera == MIDDLE
    assert moved.deg == pytest.approx(deg, abs=0.05)
    assert moved.mm == pytest.approx(mm, abs=1.5)


def test_people_alone_move_no_camera(looks: dict[int, dict[int, Look]], learnt: DriftWatch) -> None:
    watch = copy.deepcopy(learnt)
    for frame in watched_frames(BUMP_FRAME, END):
        watch.take(looks[frame])
        assert watch.status().moved == ()
    assert {camera.state for camera in watch.status().cameras} <= {"in place", "not seen"}


def test_a_rig_that_is_pushed_as_a_whole_keeps_its_calibration(room: DriftRoom, learnt: DriftWatch) -> None:
    push = se3_exp(np.array([0.0, 0.0, np.deg2rad(0.6), 0.008, 0.0, 0.0]))
    scene = replace(room.rig.scene, T_room_rig=room.rig.scene.T_room_rig @ push)
    pushed = {k: VirtualKinect(room.settings, scene, k) for k in room.kinects}
    watch = copy.deepcopy(learnt)
    for frame in watched_frames(BUMP_FRAME, BUMP_FRAME + 60):
        watch.take({k: look_of(kinect, frame) for k, kinect in pushed.items()})
    status = watch.status()
    assert status.moved == ()
    assert status.rig_mm == pytest.approx(8.0, abs=2.0)


def test_moved_furniture_moves_no_camera(room: DriftRoom, learnt: DriftWatch) -> None:
    """All of it at once, by 3 cm, while the walls stay: the room's surfaces are its shell, then furniture."""
    shell, scene = 6, room.rig.scene
    surfaces = tuple(
        surface if number < shell else replace(surface, corner=surface.corner + np.array([0.018, 0.024, 0.0]))
        for number, surface in enumerate(scene.surfaces)
    )
    moved = replace(scene, surfaces=surfaces)
    kinects = {k: VirtualKinect(room.settings, moved, k) for k in room.kinects}
    watch = copy.deepcopy(learnt)
    for frame in watched_frames(BUMP_FRAME, BUMP_FRAME + 60):
        watch.take({k: look_of(kinect, frame) for k, kinect in kinects.items()})
        assert watch.status().moved == ()


def test_a_camera_turned_far_is_found_again(room: DriftRoom, reference: Reference) -> None:
    kinect = room.knocked(MIDDLE, 6.0, 30.0, BUMP_FRAME)
    look = look_of(kinect, BUMP_FRAME)
    found = relocate(reference, look.contrast, kinect.model.color)
    assert found is not None
    motion = compare(reference, look, se3_log(inverse(found))).motion
    assert motion is not None
    error = np.abs(motion.delta - true_motion(kinect)) * UNITS
    assert error[:3].max() < 0.6  # a tenth of the turn: motions are taken to be small
    assert error[3:].max() < 25  # 0.6° at 2.4 m


def test_a_camera_that_is_covered_says_nothing(
    reference: Reference, looks: dict[int, dict[int, Look]]
) -> None:
    look = looks[BUMP_FRAME][MIDDLE]
    near = np.where(look.disparity > 0, 600, 0).astype(np.uint16)  # 0.7 m everywhere
    assert compare(reference, Look(look.contrast, near)).motion is None


def test_exposure_and_shading_do_not_change_a_look() -> None:
    rng = np.random.default_rng(0)
    image = np.kron(rng.uniform(60, 140, (60, 80)), np.ones((8, 8)))
    shade = np.linspace(0.8, 1.2, 640)
    plain, shaded = (
        look_at(np.rint(one).astype(np.uint8), NOTHING).contrast for one in (image, image * shade)
    )
    assert np.abs(plain.astype(int) - shaded)[20:-20, 20:-20].mean() < 3.0
    assert plain.std() > 20


NOTHING = np.zeros((480, 640), np.uint16)


def test_no_disparity_is_zero() -> None:
    assert known_disparity(np.array([[NO_DISPARITY, 800]], np.uint16)).tolist() == [[0, 800]]


def test_what_passed_through_a_minority_of_looks_is_not_in_their_median() -> None:
    still = Look(np.full((240, 320), 128, np.uint8), np.full((480, 640), 900, np.uint16))
    passing = Look(np.full((240, 320), 20, np.uint8), np.full((480, 640), 600, np.uint16))
    blind = Look(still.contrast, NOTHING)
    middle = median_look([still, passing, still, blind, still, passing, still])
    assert (middle.contrast == 128).all()
    assert np.allclose(middle.disparity, 900)
    assert (median_look([still, blind, blind]).disparity == 0).all()
    assert np.allclose(mean_look([still, still, passing, blind]).disparity, 800)


def test_a_motion_changes_the_disparity_of_planes_as_predicted() -> None:
    """Against rendering a slanted wall from both places."""
    grid = DepthGrid(DEFAULT_DEPTH, np.eye(4), RawDepthModel())
    rays = np.dstack([pixel_rays(DEFAULT_DEPTH), np.ones((480, 640))])
    normal, distance = np.array([0.3, -0.2, -0.93]), -2.0  # n·p = distance
    motion = np.array([0.002, -0.003, 0.001, 0.004, 0.003, -0.005])

    def disparity(T_wall_camera: np.ndarray) -> np.ndarray:
        n = T_wall_camera[:3, :3].T @ normal
        z = (distance - normal @ T_wall_camera[:3, 3]) / (rays @ n)
        return (grid.raw_model.offset - grid.raw_model.numerator_m / z).astype(np.float32)

    before, after = disparity(np.eye(4)), disparity(se3_exp(motion))
    blocks = DepthBlocks.of(before, grid, None)
    assert blocks.flat.all()
    assert np.allclose(blocks.changes(before, after), blocks.jacobian @ motion, atol=0.05)


def panoramas(room: DriftRoom, frames: range, knocked: VirtualKinect | None = None) -> list[PanoramicFrame]:
    cameras = room.kinects | ({} if knocked is None else {MIDDLE: knocked})
    return [PanoramicFrame.of(k, {i: kinect.frame(k) for i, kinect in cameras.items()}) for k in frames]


@pytest.fixture(scope="module")
def calibration(room: DriftRoom) -> RigCalibration:
    return calibration_of(room.calibrated_poses())


def test_check_finds_a_small_bump_with_frames_from_right_after_the_calibration(
    room: DriftRoom, calibration: RigCalibration
) -> None:
    before = panoramas(room, range(0, 20, 4))
    now = panoramas(room, range(60, 68, 4), room.knocked(MIDDLE, 0.5, 0.0, 30))
    description = rig_description(room.settings)
    status = check(calibration, description, now, before).status
    assert [camera.camera for camera in status.moved] == [MIDDLE]
    assert check(calibration, description, before[:2], before).status.moved == ()


def test_check_without_earlier_frames_goes_by_the_calibration(
    room: DriftRoom, calibration: RigCalibration
) -> None:
    now = panoramas(room, range(0, 12, 4))
    description = rig_description(room.settings)
    fine = check(calibration, description, now)
    assert (fine.status.moved, fine.unknown) == ((), ())
    poses = calibration.poses
    poses[MIDDLE] = poses[MIDDLE] @ se3_exp(np.deg2rad([1.0, 0.7, 0, 0, 0, 0]))
    status = check(calibration_of(poses), description, now).status
    assert [camera.camera for camera in status.moved] == [MIDDLE]
    assert status.moved[0].found_by == "the calibration"


def test_check_names_the_cameras_of_which_nothing_is_known(
    room: DriftRoom, calibration: RigCalibration
) -> None:
    (panorama,) = panoramas(room, range(1))
    without = {**panorama.frames, 2: replace(room.kinects[2].frame(0), raw=None)}
    found = check(calibration, rig_description(room.settings), [PanoramicFrame.of(0, without)])
    assert found.unknown == (2,)
