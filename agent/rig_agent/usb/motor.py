"""Light and tilt of a Kinect 1414, through its motor's own USB device.

Asked through pyusb and not through libfreenect, for the reasons that usb/accelerometer.py gives.
"""

from contextlib import suppress
from typing import TYPE_CHECKING, Literal

from rig_agent.sources.base import ControlRefused

if TYPE_CHECKING:
    from rig_agent.usb.enumerate import UsbDevice

Led = Literal["off", "green", "red", "yellow", "blink_green", "blink_red_yellow"]

# Requests and values: tilt.c and `freenect_led_options` of libfreenect 0.5.
LED_CODES: dict[Led, int] = {
    "off": 0,
    "green": 1,
    "red": 2,
    "yellow": 3,
    "blink_green": 4,
    "blink_red_yellow": 6,
}
MAX_TILT_DEG = 27.0  # the motor's range by Microsoft's data sheet; libfreenect would allow 31
_HOST_TO_DEVICE_VENDOR, _SET_LED, _SET_TILT = 0x40, 0x06, 0x31
_TIMEOUT_MS = 250  # an idle motor answers within a millisecond


class Motor:
    """What stands beside one Kinect's camera; refuses everything where there is none."""

    def __init__(self, device: "UsbDevice | None") -> None:
        """Nothing is sent yet."""
        self._device = device

    def set_led(self, led: Led) -> None:
        """Light the LED; ControlRefused says why it stays as it is."""
        self._send(_SET_LED, LED_CODES[led])

    def set_tilt(self, tilt_deg: float) -> None:
        """Begin to turn to this angle above the horizon, by the Kinect's own sense of gravity.

        It takes seconds. ControlRefused beyond ±MAX_TILT_DEG, or where no motor answers.
        """
        if not -MAX_TILT_DEG <= tilt_deg <= MAX_TILT_DEG:  # false for NaN, too
            raise ControlRefused(f"the motor turns from -{MAX_TILT_DEG:g} to {MAX_TILT_DEG:g} degrees")
        self._send(_SET_TILT, round(2 * tilt_deg) & 0xFFFF)  # half degrees, two's complement

    def light(self, led: Led) -> None:
        """Show how it goes, where there is something to show it with."""
        if self._device is not None:
            with suppress(ControlRefused):  # a motor that is mute or gone is no reason to do without images
                self.set_led(led)

    def close(self) -> None:
        """Put the light out."""
        import usb.util

        self.light("off")
        if self._device is not None:
            usb.util.dispose_resources(self._device)

    def _send(self, request: int, value: int) -> None:
        if self._device is None:
            raise ControlRefused(
                "this Kinect has no motor device: only model 1414 (models 1473 and K4W answer through their "
                "audio device, and only with a firmware that is not loaded)"
            )
        import usb.core

        try:
            self._device.ctrl_transfer(_HOST_TO_DEVICE_VENDOR, request, value, 0, None, timeout=_TIMEOUT_MS)
        except (usb.core.USBError, ValueError) as error:  # ValueError: pyusb's name for no permission
            raise ControlRefused(f"the Kinect's motor does not answer: {error}") from error
