"""The virtual bus itself: motor, LED and accelerometer through pyusb, and as libfreenect reads it."""

import ctypes as c
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import usb.core

from rig_agent.sources.libfreenect import load_libfreenect
from rig_agent.usb.enumerate import kinect_cameras, motor_beside, usb_devices
from rig_agent.usb.motor import Led, Motor, Reading
from support.virtual_usb.virtual_bus import VirtualBus, VirtualKinect

MOTOR = 0x02B0
REQUEST_IN, REQUEST_OUT = 0xC0, 0x40
LED, STATE = 0x06, 0x32
FREENECT_DEVICE_MOTOR, FREENECT_DEVICE_CAMERA, FREENECT_TILT_MOVING = 1, 2, 4


def test_the_motor_answers_with_the_posture_and_logs_its_commands(usb_bus: VirtualBus) -> None:
    kinect = usb_bus.add_kinect("A00364A11111111A")
    kinect.write("accel", "12 -819 30 20 0")
    motor = next(device for device in usb_devices() if device.idProduct == MOTOR)
    motor.ctrl_transfer(REQUEST_OUT, LED, 1, 0, None)
    state = bytes(motor.ctrl_transfer(REQUEST_IN, STATE, 0, 0, 10))
    usb.util.dispose_resources(motor)
    assert struct.unpack(">2x3hbB", state) == (12, -819, 30, 20, 0)
    assert "led 1" in kinect.log()


def motor_of_the_only_kinect() -> Motor:
    devices = usb_devices()
    return motor_beside(kinect_cameras(devices)[0], devices)


def commands(kinect: VirtualKinect) -> list[str]:
    return [line for line in kinect.log() if line.startswith("audio ")]


@contextmanager
def libfreenect_device(subdevices: int) -> Iterator[tuple[Any, c.c_void_p]]:
    """The first Kinect, opened by libfreenect; the library and the device."""
    library = load_libfreenect()
    library.freenect_get_tilt_state.restype = c.POINTER(TiltState)
    context, device = c.c_void_p(), c.c_void_p()
    assert library.freenect_init(c.byref(context), None) == 0
    library.freenect_select_subdevices(context, subdevices)
    assert library.freenect_open_device(context, c.byref(device), 0) == 0
    yield library, device
    library.freenect_close_device(device)
    library.freenect_shutdown(context)


class TiltState(c.Structure):
    """`freenect_raw_tilt_state`."""

    _fields_ = (("x", c.c_int16), ("y", c.c_int16), ("z", c.c_int16), ("tilt", c.c_int8), ("status", c.c_int))


def test_the_motors_answer_is_read_as_libfreenect_reads_it(usb_bus: VirtualBus) -> None:
    usb_bus.add_kinect("A00364A11111111A").write("accel", "12 -819 30 -20 4")
    motor = motor_of_the_only_kinect()
    ours = motor.feel()
    motor.close()
    with libfreenect_device(FREENECT_DEVICE_MOTOR) as (library, device):
        assert library.freenect_update_tilt_state(device) == 10
        theirs = library.freenect_get_tilt_state(device).contents
    assert ours == Reading(theirs.x, theirs.y, theirs.z, turning=theirs.status == FREENECT_TILT_MOVING)


@pytest.mark.parametrize("model", ["1473", "k4w"])
def test_the_audio_device_is_asked_and_heard_as_by_libfreenect(usb_bus: VirtualBus, model: str) -> None:
    kinect = usb_bus.add_kinect("B50123456789012B", model)
    kinect.write("accel", "12 -819 30 -20 0")
    leds: dict[Led, int] = {"off": 0, "green": 1, "red": 2, "yellow": 3, "blink_green": 4}
    motor = motor_of_the_only_kinect()
    for led in leds:
        motor.set_led(led)
    motor.set_tilt(-11)
    ours = motor.feel()
    ours_told = commands(kinect)
    motor.close()
    with libfreenect_device(FREENECT_DEVICE_CAMERA | FREENECT_DEVICE_MOTOR) as (library, device):
        before = len(commands(kinect))
        assert [library.freenect_set_led(device, code) for code in leds.values()] == [0] * len(leds)
        assert library.freenect_set_tilt_degs(device, c.c_double(-11)) == 0
        assert library.freenect_update_tilt_state(device) == 0
        theirs = library.freenect_get_tilt_state(device).contents
        theirs_told = commands(kinect)[before:]
    assert ours_told == theirs_told
    assert ours[:3] == (theirs.x, theirs.y, theirs.z)


def test_a_replugged_kinect_has_a_new_address_at_its_old_port(usb_bus: VirtualBus) -> None:
    kinect = usb_bus.add_kinect("A00364A11111111A")
    before = usb_devices()[0]
    place, address = before.port_numbers, before.address
    kinect.unplug()
    assert usb_devices() == []
    kinect.plug()
    after = usb_devices()[0]
    assert after.port_numbers == place
    assert after.address != address
