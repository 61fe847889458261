"""The virtual bus itself: motor, LED and accelerometer through pyusb, and as libfreenect reads it."""

import ctypes as c
import struct

import usb.core

from rig_agent.sources.libfreenect import load_libfreenect
from rig_agent.usb.accelerometer import Reading
from rig_agent.usb.enumerate import usb_devices
from support.virtual_usb.virtual_bus import VirtualBus

MOTOR = 0x02B0
REQUEST_IN, REQUEST_OUT = 0xC0, 0x40
LED, STATE = 0x06, 0x32
FREENECT_DEVICE_MOTOR, FREENECT_TILT_MOVING = 1, 4


def test_the_motor_answers_with_the_posture_and_logs_its_commands(usb_bus: VirtualBus) -> None:
    kinect = usb_bus.add_kinect("A00364A11111111A")
    kinect.write("accel", "12 -819 30 20 0")
    motor = next(device for device in usb_devices() if device.idProduct == MOTOR)
    motor.ctrl_transfer(REQUEST_OUT, LED, 1, 0, None)
    state = bytes(motor.ctrl_transfer(REQUEST_IN, STATE, 0, 0, 10))
    usb.util.dispose_resources(motor)
    assert struct.unpack(">2x3hbB", state) == (12, -819, 30, 20, 0)
    assert "led 1" in kinect.log()


class TiltState(c.Structure):
    """`freenect_raw_tilt_state`."""

    _fields_ = (("x", c.c_int16), ("y", c.c_int16), ("z", c.c_int16), ("tilt", c.c_int8), ("status", c.c_int))


def test_the_motors_answer_is_read_as_libfreenect_reads_it(usb_bus: VirtualBus) -> None:
    usb_bus.add_kinect("A00364A11111111A").write("accel", "12 -819 30 -20 4")
    motor = next(device for device in usb_devices() if device.idProduct == MOTOR)
    ours = Reading.parse(bytes(motor.ctrl_transfer(REQUEST_IN, STATE, 0, 0, 10)))
    usb.util.dispose_resources(motor)
    library = load_libfreenect()
    library.freenect_get_tilt_state.restype = c.POINTER(TiltState)
    context, device = c.c_void_p(), c.c_void_p()
    assert library.freenect_init(c.byref(context), None) == 0
    library.freenect_select_subdevices(context, FREENECT_DEVICE_MOTOR)
    assert library.freenect_open_device(context, c.byref(device), 0) == 0
    assert library.freenect_update_tilt_state(device) == 10
    theirs = library.freenect_get_tilt_state(device).contents
    assert ours == Reading(theirs.x, theirs.y, theirs.z, turning=theirs.status == FREENECT_TILT_MOVING)
    library.freenect_close_device(device)
    library.freenect_shutdown(context)


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
