"""Tiles: up is up, colours are right, and nothing is made that nobody looks at."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rig_protocol.camera import CameraModel
from rig_protocol.frames import NO_DISPARITY, ImageU8, PanoramicFrame, RgbdFrame
from rig_protocol.gravity import Gravity
from rig_protocol.rig_folder import CameraEntry, RigDescription, RingDrawing
from rig_server.console.camera_pictures import Mode, depth_picture
from rig_server.console.picture_guide import PictureGuide
from rig_server.console.tiles import Look, camera_picture, tile_round
from rig_server.console.upright import felt_turns, quarter_turns, turned
from support.box_room import calibration_of, ring_poses

BLUE, GREEN, RED = (255, 0, 0), (0, 255, 0), (0, 0, 255)
UNKNOWN = PictureGuide({}, {}, {})
RING = PictureGuide.of(
    RigDescription(tuple(CameraEntry(i, f"cam{i:02d}", CameraModel(), T) for i, T in ring_poses(3).items())),
    None,
)
DOWN = {0: (0.0, 1.0, 0.0), 1: (1.0, 0.0, 0.0), 2: (0.0, -1.0, 0.0), 3: (-1.0, 0.0, 0.0)}
"""Down in the camera, by the quarter turns clockwise that set its image upright."""


def mosaic(image: ImageU8) -> ImageU8:
    """What a GRBG sensor makes of a picture in BGR."""
    bayer = image[..., 1].copy()
    bayer[0::2, 1::2] = image[0::2, 1::2, 2]
    bayer[1::2, 0::2] = image[1::2, 0::2, 0]
    return bayer


def scene() -> ImageU8:
    """As one sees it upright: red above, blue below, 480 × 640."""
    image = np.zeros((640, 480, 3), np.uint8)
    image[:320], image[320:] = RED, BLUE
    return image


def as_the_sensor_sees_it(turns: int) -> RgbdFrame:
    """A camera that must be turned so often clockwise."""
    image = np.ascontiguousarray(np.rot90(scene(), turns))
    return RgbdFrame(0, 0, 0, bayer=mosaic(image), gravity=Gravity(DOWN[turns]))


def is_near(pixel: ImageU8, color: tuple[int, int, int]) -> bool:
    return bool(np.abs(pixel.astype(int) - color).max() < 30)


@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize("full", [False, True])
def test_up_is_up_however_the_camera_is_mounted(turns: int, full: bool) -> None:
    image = camera_picture(as_the_sensor_sees_it(turns), UNKNOWN, Mode.COLOR, full)
    assert image is not None
    height, width = image.shape[:2]
    assert height / width == 640 / 480
    assert height == (640 if full else 320)
    assert is_near(image[height // 8, width // 2], RED)
    assert is_near(image[-height // 8, width // 2], BLUE)


def test_the_drawing_says_what_is_up_where_no_camera_feels_it() -> None:
    seen = np.ascontiguousarray(np.rot90(scene(), 1))  # the ring's cameras have image x down
    frame = RgbdFrame(1, 0, 0, color=seen)
    image = camera_picture(frame, RING, Mode.COLOR, False)
    assert image is not None
    assert is_near(image[40, 120], RED)
    assert camera_picture(frame, UNKNOWN, Mode.COLOR, False).shape[:2] == (240, 320)  # type: ignore[union-attr]


def test_a_calibration_in_a_cameras_own_frame_says_what_is_up() -> None:
    poses = ring_poses()
    tilted = {i: np.linalg.inv(poses[0]) @ T for i, T in poses.items()}
    description = RigDescription(tuple(CameraEntry(i, f"cam{i:02d}", CameraModel()) for i in poses))
    guide = PictureGuide.of(description, calibration_of(tilted, "camera 0"))
    assert guide.turns == dict.fromkeys(poses, 1)


def test_a_camera_that_looks_up_is_left_as_it_is() -> None:
    assert quarter_turns(np.array([0.1, -0.2, 0.97])) == 0
    assert felt_turns(Gravity((0.0, 0.0, 1.0))) == 0


def test_a_turn_is_clockwise() -> None:
    image = np.arange(6, dtype=np.uint8).reshape(2, 3)
    assert np.array_equal(turned(image, 1), np.rot90(image, -1))


def test_near_is_red_far_is_blue_and_nothing_is_dark() -> None:
    model = CameraModel().raw_model
    raw = np.full((4, 6), NO_DISPARITY, np.uint16)
    raw[:, 2:4] = round(model.offset - model.numerator_m / 0.6)
    raw[:, 4:] = round(model.offset - model.numerator_m / 4.8)
    by_raw = depth_picture(RgbdFrame(0, 0, 0, raw=raw), model, True)
    depth_mm = np.zeros((4, 6), np.uint16)
    depth_mm[:, 2:4], depth_mm[:, 4:] = 600, 4800
    by_mm = depth_picture(RgbdFrame(0, 0, 0, depth_mm=depth_mm), model, True)
    for image in (by_raw, by_mm):
        assert image is not None
        nothing, near, far = (image[0, column].astype(int) for column in (0, 2, 4))
        assert nothing.max() < 40
        assert near[2] > 2 * near[0]
        assert far[0] > 2 * far[2]


def test_overlaps_are_tinted_in_one_colour_in_both_cameras_and_elsewhere_nothing_changes() -> None:
    grey = np.full((480, 640, 3), 100, np.uint8)
    pictures = {}
    for camera_id in range(3):
        frame = RgbdFrame(camera_id, 0, 0, color=grey)
        image = camera_picture(frame, RING, Mode.OVERLAP, False)
        assert image is not None
        pictures[camera_id] = image
    # Slot 1 is to the left of slot 0 as one looks outward: counter-clockwise seen from above.
    assert np.array_equal(pictures[0][160, 0], pictures[1][160, -1])
    assert np.array_equal(pictures[1][160, 0], pictures[2][160, -1])
    assert not np.array_equal(pictures[0][160, 0], pictures[1][160, 0])
    assert np.array_equal(pictures[1][160, 120], (100, 100, 100))


def test_only_what_is_looked_at_is_made_and_a_missing_camera_has_no_tile() -> None:
    frames = {i: replace(as_the_sensor_sees_it(1), camera_id=i) for i in range(2)}
    panorama = PanoramicFrame.of(0, {**frames, 2: None})
    made = tile_round(panorama, 5, RING, [Look(Mode.COLOR), Look(Mode.COLOR, enlarged=1)])
    assert set(made.tiles) == {(Mode.COLOR, 0, False), (Mode.COLOR, 1, False), (Mode.COLOR, 1, True)}
    assert [tile.camera_id for tile in made.seen_by(Look(Mode.COLOR))] == [0, 1]
    small, large = made.seen_by(Look(Mode.COLOR, enlarged=1))
    assert (small.width, small.height, large.width, large.height) == (240, 320, 480, 640)
    assert made.seen_by(Look(Mode.DEPTH)) == []
    decoded = cv2.imdecode(np.frombuffer(large.data, np.uint8), cv2.IMREAD_COLOR)
    assert decoded.shape == (640, 480, 3)


def test_an_image_that_is_none_leaves_the_other_cameras_their_tiles() -> None:
    """An agent may send what it likes: images of one pixel, too."""
    good = as_the_sensor_sees_it(1)
    for shape in ((1, 1), (481, 641)):
        odd = RgbdFrame(1, 0, 0, bayer=np.zeros(shape, np.uint8))
        made = tile_round(PanoramicFrame.of(0, {0: good, 1: odd}), 5, UNKNOWN, [Look()])
        assert (Mode.COLOR, 0, False) in made.tiles


def test_a_tile_is_timed_from_its_last_datagram_and_a_recordings_from_when_it_was_played() -> None:
    frame = replace(as_the_sensor_sees_it(0), received_ns=90_000_000)
    live = tile_round(PanoramicFrame.of(0, {0: frame}), 100_000_000, UNKNOWN, [Look()])
    assert live.tiles[Mode.COLOR, 0, False].received_ns == 90_000_000
    for day_ns in (-86_400_000_000_000, 86_400_000_000_000):
        played = tile_round(PanoramicFrame.of(0, {0: frame}), 100_000_000 + day_ns, UNKNOWN, [Look()])
        assert played.tiles[Mode.COLOR, 0, False].received_ns == 100_000_000 + day_ns


def test_a_ring_without_drawing_or_calibration_has_no_tints() -> None:
    assert RingDrawing().T_rig_camera(0) is not None
    description = RigDescription((CameraEntry(0, "cam00", CameraModel()),))
    assert PictureGuide.of(description, None).tints == {}
