"""LED, tilt and accelerometer behind the audio device of a 1473 and K4W, through pyusb on the virtual bus."""

import struct
import threading

import pytest

from rig_agent.sources.base import ControlRefused
from rig_agent.usb.audio_motor import AudioMotor
from rig_agent.usb.enumerate import AUDIO, kinect_cameras, motor_beside, usb_devices
from rig_agent.usb.motor import Motor, Reading
from support.virtual_usb.virtual_bus import VirtualBus, VirtualKinect

FELT = Reading(12, -819, 30, turning=False)


@pytest.fixture(params=["1473", "k4w"])
def kinect(usb_bus: VirtualBus, request: pytest.FixtureRequest) -> VirtualKinect:
    kinect = usb_bus.add_kinect("B50123456789012B", model=request.param)
    kinect.write("accel", "12 -819 30 -20 0")
    return kinect


@pytest.fixture
def motor(kinect: VirtualKinect) -> Motor:
    devices = usb_devices()
    motor = motor_beside(kinect_cameras(devices)[0], devices)
    assert isinstance(motor, AudioMotor), kinect.model
    return motor


def test_each_command_is_acknowledged_and_the_next_one_has_its_own_answer(
    motor: Motor, kinect: VirtualKinect
) -> None:
    assert motor.set_led("red") == "red"
    assert motor.feel() == FELT
    assert motor.set_tilt(10.4) == 10
    kinect.write("accel", "0 819 0 0 0")
    assert motor.feel() == Reading(0, 819, 0, turning=False)
    motor.close()
    assert kinect.open_handles() == 0


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("magic", "something else"),
        ("tag", "something else"),
        ("short", "4 bytes, not 12"),
        ("status", "status 5"),
    ],
)
def test_an_acknowledgement_that_is_none_is_refused_and_the_next_is_believed(
    motor: Motor, kinect: VirtualKinect, fault: str, words: str
) -> None:
    kinect.write("audio_fault", fault)
    for ask in (motor.feel, lambda: motor.set_led("green"), lambda: motor.set_tilt(0)):
        with pytest.raises(ControlRefused, match=words):
            ask()
    kinect.clear("audio_fault")
    assert motor.feel() == FELT


def test_answers_that_come_too_late_are_not_taken_for_those_of_the_next_command(
    motor: Motor, kinect: VirtualKinect
) -> None:
    kinect.write("mute_motor")
    for _ in range(2):
        with pytest.raises(ControlRefused, match="does not answer"):
            motor.feel()
    kinect.write("accel", "0 819 0 0 0")
    kinect.clear("mute_motor")
    assert motor.feel() == Reading(0, 819, 0, turning=False)


def test_what_another_program_left_unread_is_not_taken_for_an_answer(
    motor: Motor, kinect: VirtualKinect
) -> None:
    audio = next(device for device in usb_devices() if device.idProduct in AUDIO)
    audio.write(0x01, struct.pack("<4I", 0x06022009, 1, 104, 0x8032))
    kinect.write("accel", "0 819 0 0 0")
    assert motor.feel() == Reading(0, 819, 0, turning=False)


def test_an_unplugged_kinect_is_refused_in_words(motor: Motor, kinect: VirtualKinect) -> None:
    motor.feel()
    kinect.unplug()
    with pytest.raises(ControlRefused, match="does not answer"):
        motor.feel()
    motor.close()


def test_commands_of_one_thread_and_readings_of_another_do_not_mix(motor: Motor) -> None:
    readings: list[Reading] = []
    reader = threading.Thread(target=lambda: readings.extend(motor.feel() for _ in range(50)))
    reader.start()
    for _ in range(50):
        motor.set_led("green")
    reader.join()
    assert readings == [FELT] * 50
