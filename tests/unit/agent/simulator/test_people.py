"""Rules of the people in the simulated room: where they walk, what they hide, what they leave alone."""

import numpy as np
import pytest

from rig_agent.simulator.people import People, Standing
from rig_agent.simulator.ring import VirtualRig
from rig_agent.simulator.scene import KEEP_OUT_M, build_scene
from rig_agent.simulator.settings import SimulatorSettings
from rig_protocol.frames import NO_DISPARITY

SETTINGS = SimulatorSettings(cameras=3, seed=5, people=2, patterns=False)
EMPTY = SETTINGS.model_copy(update={"people": 0})
SEEN = 40  # a frame in which somebody stands before camera SEER
SEER = 1


@pytest.fixture(scope="module")
def rig() -> VirtualRig:
    return VirtualRig(SETTINGS)


@pytest.fixture(scope="module")
def empty() -> VirtualRig:
    return VirtualRig(EMPTY)


def seen_frame(rig: VirtualRig, empty: VirtualRig) -> tuple[int, np.ndarray]:
    """The first watched frame with somebody before the camera, and where that hides the room."""
    for k in range(0, 3000, 30):
        now, before = rig.camera(SEER).frame(k).raw, empty.camera(SEER).frame(k).raw
        assert now is not None
        assert before is not None
        hidden = (now < before.astype(int) - 30) & (before != NO_DISPARITY)
        if 0.05 < hidden.mean() < 0.4:
            return k, hidden
    raise AssertionError("nobody came by")


def test_people_keep_clear_of_the_rig_and_of_the_walls() -> None:
    scene = build_scene(SETTINGS)
    length, width, _ = SETTINGS.room_m
    for time_s in np.arange(0, 200, 0.7):
        for person in People(SETTINGS, scene).at(time_s):
            place = person.T_room_person[:2, 3]
            assert np.linalg.norm(place - scene.T_room_rig[:2, 3]) >= KEEP_OUT_M
            assert (np.abs(place) < (length / 2 - 0.2, width / 2 - 0.2)).all()


def test_nobody_jumps() -> None:
    people = People(SETTINGS, build_scene(SETTINGS))
    for time_s in np.arange(0, 400, 0.5):
        for here, there in zip(people.at(time_s), people.at(time_s + 0.05), strict=True):
            assert np.linalg.norm(here.T_room_person[:2, 3] - there.T_room_person[:2, 3]) < 0.2


def test_a_frame_with_people_is_a_function_of_its_number(rig: VirtualRig) -> None:
    again = VirtualRig(SETTINGS).camera(SEER).frame(SEEN)
    here = rig.camera(SEER).frame(SEEN)
    assert np.array_equal(here.raw, again.raw)  # type: ignore[arg-type]  # a virtual Kinect has both
    assert np.array_equal(here.bayer, again.bayer)  # type: ignore[arg-type]


def test_who_stands_before_a_camera_is_nearer_and_shades_the_projector(
    rig: VirtualRig, empty: VirtualRig
) -> None:
    k, hidden = seen_frame(rig, empty)
    now, before = rig.camera(SEER).frame(k).raw, empty.camera(SEER).frame(k).raw
    assert now is not None
    assert before is not None
    shaded = (now == NO_DISPARITY) & (before != NO_DISPARITY)
    assert shaded.mean() > 0.005
    # The projector is on the right: shadows lie on the left of who throws them.
    assert np.nonzero(shaded)[1].mean() < np.nonzero(hidden)[1].mean()


def test_away_from_people_the_room_is_as_it_was(rig: VirtualRig, empty: VirtualRig) -> None:
    k, _ = seen_frame(rig, empty)
    now, before = rig.camera(SEER).frame(k), empty.camera(SEER).frame(k)
    assert now.raw is not None
    assert now.bayer is not None
    assert (now.raw == before.raw).mean() > 0.4
    darker = now.bayer.astype(int) <= before.bayer.astype(int) + 1  # type: ignore[union-attr]
    same_or_shaded = darker | (now.raw != before.raw)
    assert same_or_shaded.mean() > 0.9  # the two images see the person from 25 mm apart


def test_looped_frames_repeat_people_and_noise() -> None:
    kinect = VirtualRig(SETTINGS.model_copy(update={"frames_rendered": 2})).camera(0)
    assert kinect.frame(0).raw is kinect.frame(2).raw


def test_a_person_blocks_exactly_the_segments_through_it() -> None:
    person: Standing = People(SETTINGS, build_scene(SETTINGS)).at(0.0)[0]
    chest = person.T_room_person[:3, 3] + [0, 0, 1.1]
    away = person.T_room_person[:3, 1]  # to the left of the person
    points = np.array([chest + 2 * away, chest + 2 * away + [0, 0, 3], chest - 0.8 * away])
    assert person.blocks(points, chest - 1.0 * away).tolist() == [True, False, False]
