"""Kinects on the bus, told apart; the bus is a list of fake pyusb devices."""

from types import SimpleNamespace
from typing import Any

import pytest
import usb.core
import usb.util

from rig_agent.sources.base import ControlRefused, SourceLost
from rig_agent.usb.enumerate import KinectCamera, choose_camera, kinect_cameras, motor_beside
from rig_protocol.errors import ConfigurationError

ZEROS = "0000000000000000"


def device(
    product: int,
    ports: tuple[int, ...],
    serial: str | Exception | None,
    revision: int = 0x010B,
    interfaces: int = 1,
) -> Any:
    return SimpleNamespace(
        idProduct=product,
        bcdDevice=revision,
        bus=1,
        address=10 + sum(ports),
        port_numbers=ports,
        iSerialNumber=0 if serial is None else 3,
        serial=serial,
        configurations=lambda: (SimpleNamespace(bNumInterfaces=interfaces),),
    )


@pytest.fixture(autouse=True)
def fake_strings(monkeypatch: pytest.MonkeyPatch) -> None:
    def get_string(device: Any, _index: int) -> str:
        if isinstance(device.serial, Exception):
            raise device.serial
        return str(device.serial)

    monkeypatch.setattr(usb.util, "get_string", get_string)
    monkeypatch.setattr(usb.util, "dispose_resources", lambda _device: None)


def kinect_1414(hub: int, serial: str | Exception) -> list[Any]:
    return [
        device(0x02AE, (hub, 1), serial),
        device(0x02B0, (hub, 2), None),
        device(0x02AD, (hub, 3), serial),
    ]


def kinect_1473(hub: int, serial: str | Exception) -> list[Any]:
    return [device(0x02AE, (hub, 1), ZEROS, 0x0200), device(0x02AD, (hub, 3), serial, 0x0200)]


def kinect_k4w(hub: int, serial: str) -> list[Any]:
    return [device(0x02BF, (hub, 1), ZEROS, 0x0200), device(0x02BE, (hub, 3), serial, 0x0200)]


def identities(*kinects: list[Any]) -> list[tuple[str, str | None, str]]:
    cameras = kinect_cameras([part for kinect in kinects for part in kinect])
    assert [camera.index for camera in cameras] == list(range(len(cameras)))
    return [(camera.model, camera.serial, camera.port_path) for camera in cameras]


def test_each_model_has_its_serial_number_and_place() -> None:
    assert identities(kinect_1414(1, "A1"), kinect_1473(2, "A2"), kinect_k4w(3, "A3")) == [
        ("1414", "A1", "1-1.1"),
        ("1473", "A2", "1-2.1"),
        ("K4W", "A3", "1-3.1"),
    ]


def test_cameras_without_serial_number_take_it_from_the_audio_device_on_their_own_hub() -> None:
    first, second = kinect_1473(1, "A1"), kinect_1473(2, "A2")
    mixed = [first[0], second[1], second[0], first[1]]
    assert [camera.serial for camera in kinect_cameras(mixed)] == ["A1", "A2"]


@pytest.mark.parametrize("error", [ValueError("no langid"), usb.core.USBError("Access denied", -3, 13)])
def test_a_serial_number_that_may_not_be_read_is_unknown(error: Exception) -> None:
    assert identities(kinect_1414(1, error), kinect_1473(2, error)) == [
        ("1414", None, "1-1.1"),
        ("1473", None, "1-2.1"),
    ]


def test_a_camera_without_serial_number_and_audio_device_is_unknown() -> None:
    assert identities(kinect_1473(1, "A1")[:1]) == [("1473", None, "1-1.1")]


def cameras() -> list[KinectCamera]:
    return kinect_cameras([*kinect_1414(1, "A1"), *kinect_1414(12, "A2")])


def test_the_only_kinect_needs_no_choice() -> None:
    assert choose_camera(cameras()[:1], None, None).serial == "A1"


def test_a_port_is_not_another_port_that_begins_alike() -> None:
    assert choose_camera(cameras(), None, "1-1").serial == "A1"


def test_serial_and_port_must_both_fit() -> None:
    with pytest.raises(SourceLost, match="no Kinect A1 at USB 1-12 is connected"):
        choose_camera(cameras(), "A1", "1-12")


def test_an_empty_bus_speaks_of_cable_and_power() -> None:
    with pytest.raises(SourceLost, match=r"cable.*power supply"):
        choose_camera([], "A1", None)


def test_two_kinects_and_no_choice_lists_them() -> None:
    with pytest.raises(
        ConfigurationError, match=r"A1 \(1414\) at USB 1-1\.1; Kinect A2 \(1414\) at USB 1-12\.1"
    ):
        choose_camera(cameras(), None, None)


def test_the_motor_is_that_of_the_same_kinect_where_models_are_mixed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("rig_agent.usb.enumerate.Motor1414", lambda device: ("1414", device.port_numbers))
    monkeypatch.setattr("rig_agent.usb.enumerate.AudioMotor", lambda device: ("audio", device.port_numbers))
    with_firmware = [
        device(0x02BF, (4, 1), ZEROS, 0x0200),
        device(0x02C3, (4, 3), "D", 0x0200, interfaces=4),
    ]
    later = [device(0x02AE, (1, 1), ZEROS, 0x0200), device(0x02AD, (1, 3), "B", 0x0200, interfaces=2)]
    devices = [*later, *kinect_1414(2, "A"), *kinect_1414(3, "C"), *with_firmware]
    motors = [motor_beside(camera, devices) for camera in kinect_cameras(devices)]
    assert motors == [("audio", (1, 3)), ("1414", (2, 2)), ("1414", (3, 2)), ("audio", (4, 3))]


@pytest.mark.parametrize(
    ("kinect", "words"),
    [
        (kinect_1473(1, "A"), "a 1473 want firmware .*freenect-wavrecord"),
        (kinect_k4w(1, "A"), "a K4W want firmware"),
        (kinect_1473(1, "A")[:1], "no audio device"),
        (kinect_1414(1, "A")[:1], "no motor device"),
    ],
    ids=["1473 in its boot loader", "K4W in its boot loader", "1473 without audio", "1414 without motor"],
)
def test_a_kinect_whose_motor_cannot_be_asked_says_why(kinect: list[Any], words: str) -> None:
    motor = motor_beside(kinect_cameras(kinect)[0], kinect)
    assert not motor.is_there
    for ask in (motor.feel, lambda: motor.set_led("red"), lambda: motor.set_tilt(3)):
        with pytest.raises(ControlRefused, match=words):
            ask()
    motor.close()


def test_an_audio_device_that_vanishes_while_it_is_looked_at_is_no_motor() -> None:
    def gone() -> None:
        raise usb.core.USBError("No such device", -4, 19)

    kinect = kinect_1473(1, "A")
    kinect[1].configurations = gone
    assert not motor_beside(kinect_cameras(kinect)[0], kinect).is_there
