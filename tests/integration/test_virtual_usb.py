"""The virtual bus itself, where no source uses it yet: motor, LED and accelerometer through pyusb."""

import struct

import usb.core

from rig_agent.usb.enumerate import usb_devices
from support.virtual_usb.virtual_bus import VirtualBus

MOTOR = 0x02B0
REQUEST_IN, REQUEST_OUT = 0xC0, 0x40
LED, STATE = 0x06, 0x32


def test_the_motor_answers_with_the_posture_and_logs_its_commands(usb_bus: VirtualBus) -> None:
    kinect = usb_bus.add_kinect("A00364A11111111A")
    kinect.write("accel", "12 -819 30 20 0")
    motor = next(device for device in usb_devices() if device.idProduct == MOTOR)
    motor.ctrl_transfer(REQUEST_OUT, LED, 1, 0, None)
    state = bytes(motor.ctrl_transfer(REQUEST_IN, STATE, 0, 0, 10))
    usb.util.dispose_resources(motor)
    assert struct.unpack(">2x3hbB", state) == (12, -819, 30, 20, 0)
    assert "led 1" in kinect.log()


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
