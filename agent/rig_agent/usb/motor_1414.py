"""LED, tilt and accelerometer of a Kinect 1414, behind its motor's own USB device."""

import struct
from typing import TYPE_CHECKING, Any

from rig_agent.sources.base import ControlRefused
from rig_agent.usb.motor import Led, Motor, Reading

if TYPE_CHECKING:
    from rig_agent.usb.enumerate import UsbDevice

# Requests, values and the state's layout: tilt.c and `freenect_led_options` of libfreenect 0.5.
LED_CODES: dict[Led, int] = {
    "off": 0,
    "green": 1,
    "red": 2,
    "yellow": 3,
    "blink_green": 4,
    "blink_red_yellow": 6,
}
_TO_DEVICE, _SET_LED, _SET_TILT = 0x40, 0x06, 0x31
_FROM_DEVICE, _GET_STATE = 0xC0, 0x32
_STATE = struct.Struct(">2x3hbB")  # x, y, z, tilt in half degrees, what the motor does
_MOVING = 4  # of FREENECT_TILT_STATUS_*
_TIMEOUT_MS = 250  # an idle motor answers within a millisecond


def parse_state(answer: bytes) -> Reading:
    """Of the motor's ten bytes; struct.error for more or fewer."""
    x, y, z, _, status = _STATE.unpack(answer)
    return Reading(x, y, z, status == _MOVING)


class Motor1414(Motor):
    """Control transfers to the motor's device."""

    def __init__(self, device: "UsbDevice") -> None:
        """Nothing is sent yet."""
        self._device = device

    def set_led(self, led: Led) -> Led:
        """Light the LED, which knows all of them."""
        self._transfer(_TO_DEVICE, _SET_LED, LED_CODES[led], None)
        return led

    def feel(self) -> Reading:
        """Ask for the motor's state."""
        answer = bytes(self._transfer(_FROM_DEVICE, _GET_STATE, 0, _STATE.size))
        try:
            return parse_state(answer)
        except struct.error as error:
            raise ControlRefused(
                f"the Kinect's motor answers {len(answer)} bytes, not {_STATE.size}"
            ) from error

    def close(self) -> None:
        """Put the light out and let the device go."""
        import usb.util

        super().close()
        usb.util.dispose_resources(self._device)

    def _turn(self, tilt_deg: float) -> float:
        half_degrees = round(2 * tilt_deg)
        self._transfer(_TO_DEVICE, _SET_TILT, half_degrees & 0xFFFF, None)  # two's complement
        return half_degrees / 2

    def _transfer(self, kind: int, request: int, value: int, size: int | None) -> Any:
        import usb.core

        try:
            return self._device.ctrl_transfer(kind, request, value, 0, size, timeout=_TIMEOUT_MS)
        except (usb.core.USBError, ValueError) as error:  # ValueError: pyusb's name for no permission
            raise ControlRefused(f"the Kinect's motor does not answer: {error}") from error
