"""What calibration is given of a camera: its good frames, and which way it felt down in them."""

import numpy as np

from rig_calib.view import CameraView, views_from_panoramas
from rig_protocol.camera import CameraModel
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.gravity import KINECT_SIGMA_DEG, Gravity
from rig_protocol.rig_folder import CameraEntry, RigDescription

COLOR = np.zeros((480, 640), np.uint8)
DOWN, SIDEWAYS = Gravity((0.0, 1.0, 0.0), 2.0), Gravity((1.0, 0.0, 0.0), 2.0)


def view_of(*felt: Gravity | None, damaged: int | None = None) -> CameraView:
    """A camera's view over frames in which it felt this; one of them damaged."""
    frames = [
        RgbdFrame(0, k, 0, color=COLOR, gravity=gravity, damaged=k == damaged)
        for k, gravity in enumerate(felt)
    ]
    panoramas = [PanoramicFrame.of(k, {0: frame}) for k, frame in enumerate(frames)]
    [view] = views_from_panoramas(RigDescription((CameraEntry(0, "cam00", CameraModel()),)), panoramas)
    return view


def test_frames_that_tell_of_gravity_speak_for_those_that_do_not() -> None:
    view = view_of(None, DOWN, DOWN)
    assert view.gravity is not None
    np.testing.assert_array_equal(view.gravity, DOWN.down)
    assert view.gravity_sigma_deg == 2.0


def test_a_camera_that_was_turned_between_its_frames_has_no_gravity() -> None:
    assert view_of(DOWN, SIDEWAYS).gravity is None


def test_a_damaged_frame_is_not_heard() -> None:
    view = view_of(DOWN, SIDEWAYS, damaged=1)
    assert view.gravity is not None
    assert len(view.color) == 1


def test_a_camera_without_accelerometer_has_no_gravity() -> None:
    view = view_of(None)
    assert view.gravity is None
    assert view.gravity_sigma_deg == KINECT_SIGMA_DEG
