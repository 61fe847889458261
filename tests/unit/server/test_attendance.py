"""Who is expected, who is here, what the operator reads about the others."""

from rig_protocol.events import HelloRefused
from rig_protocol.messages import RejectReason
from rig_server.attendance import SETTLED_S, absence_message, absent_names, is_whole
from rig_server.config import CameraSettings, RigSettings

LISTED = RigSettings(cameras=(CameraSettings(id=0), CameraSettings(id=4, name="door"), CameraSettings(id=5)))
COUNTED = RigSettings(expected_cameras=3)
OPEN = RigSettings()


def test_a_listed_rig_is_whole_when_every_listed_camera_is_connected() -> None:
    assert not is_whole(LISTED, {0, 4}, 100.0)
    assert is_whole(LISTED, {0, 4, 5}, 0.0)


def test_a_counted_rig_is_whole_when_so_many_are_connected() -> None:
    assert not is_whole(COUNTED, {0, 9}, 100.0)
    assert is_whole(COUNTED, {0, 7, 9}, 0.0)


def test_an_open_rig_is_whole_when_two_have_come_and_nobody_followed() -> None:
    assert not is_whole(OPEN, {0}, 100.0)
    assert not is_whole(OPEN, {0, 1}, SETTLED_S / 2)
    assert is_whole(OPEN, {0, 1}, SETTLED_S)


def test_absent_cameras_are_called_by_their_names() -> None:
    assert absent_names(LISTED, {0}) == ["door", "cam05"]
    assert absent_names(COUNTED, {1}) == ["cam00", "cam02"]
    assert absent_names(COUNTED, {10, 11}) == ["cam00"]
    assert absent_names(OPEN, set()) == ["cam00", "cam01"]


def test_the_message_names_the_absent_what_was_refused_and_what_to_look_at() -> None:
    refused = HelloRefused(("10.0.0.17", 9), RejectReason.VERSION_MISMATCH, "speaks version 9")
    message = absence_message(LISTED, {0}, [refused])
    assert "2 of 3 cameras have not come: door, cam05" in message
    assert "refused 10.0.0.17: speaks version 9" in message
    assert "systemctl status 'rig-agent@*'" in message
