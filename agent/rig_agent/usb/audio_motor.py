"""LED, tilt and accelerometer of a Kinect 1473 or K4W, behind its audio device, once firmware runs in it.

Commands and answers are bulk transfers. A command carries a tag; the device answers with data, if any was
asked for, and then with an acknowledgement that carries the same tag and a status, zero for done.
"""

import itertools
import struct
import threading
from contextlib import suppress
from typing import TYPE_CHECKING

from rig_agent.sources.base import ControlRefused
from rig_agent.usb.motor import Led, Motor, Reading

if TYPE_CHECKING:
    from rig_agent.usb.enumerate import UsbDevice

# Layouts, numbers and LED values: tilt.c of libfreenect 0.5 (`fn_alt_motor_command`, `fnusb_set_led_alt`).
# That acknowledgements repeat the tag: `get_reply` in its loader.c, which speaks with the same device.
_COMMAND = struct.Struct(
    "<4I"
)  # magic, tag, bytes of data wanted, command; then an argument, but for the state
_ARGUMENT = struct.Struct("<i")
_ACKNOWLEDGEMENT = struct.Struct("<3I")  # magic, tag, status
_STATE = struct.Struct("<16x4i72x")  # x, y, z in counts, tilt in degrees; nobody knows the rest
_COMMAND_MAGIC, _ACKNOWLEDGEMENT_MAGIC = 0x06022009, 0x0A6FE000
_SET_LED, _GET_STATE, _SET_TILT = 0x10, 0x8032, 0x803B
_OUT, _IN, _MAX_ANSWER = 0x01, 0x81, 512

_OFF, _BLINK_GREEN, _GREEN, _RED = 1, 2, 3, 4
_LED_CODES = {"off": _OFF, "blink_green": _BLINK_GREEN, "green": _GREEN, "red": _RED}
_NEAREST: dict[Led, Led] = {
    "yellow": "green",
    "blink_red_yellow": "blink_green",
}  # these models have no yellow

_TIMEOUT_MS = 250
_STALE_MS, _MAX_STALE = 20, 8
_BUSY_S = 1.5  # longer than one exchange with all its time-outs


class AudioMotor(Motor):
    """Bulk transfers to the audio device; one thread may control while another reads the accelerometer."""

    def __init__(self, audio: "UsbDevice") -> None:
        """Nothing is sent yet."""
        self._audio = audio
        self._tags = itertools.count(1)
        self._in_step = False  # no answer to an earlier command is still to be read
        self._lock = threading.Lock()

    def set_led(self, led: Led) -> Led:
        """Light the LED, or the nearest that it has."""
        shown = _NEAREST.get(led, led)
        self._exchange(_SET_LED, argument=_LED_CODES[shown])
        return shown

    def feel(self) -> Reading:
        """Ask for the state. It does not say whether the motor turns: only scattered readings tell that."""
        x, y, z, _ = _STATE.unpack(self._exchange(_GET_STATE, answer_size=_STATE.size))
        return Reading(x, y, z, turning=False)

    def close(self) -> None:
        """Put the light out and let the device go."""
        import usb.util

        super().close()
        if self._lock.acquire(timeout=_BUSY_S):  # a libusb that does not return keeps its device
            usb.util.dispose_resources(self._audio)
            self._lock.release()

    def _turn(self, tilt_deg: float) -> float:
        degrees = round(tilt_deg)
        self._exchange(_SET_TILT, argument=degrees)
        return float(degrees)

    def _exchange(self, command: int, argument: int | None = None, answer_size: int = 0) -> bytes:
        """One command and all that answers it; ControlRefused within _BUSY_S for anything else."""
        import usb.core

        if not self._lock.acquire(timeout=_BUSY_S):
            raise ControlRefused("the Kinect's audio device, which holds its motor, is still being asked")
        try:
            if not self._in_step:
                self._drop_stale_answers()
            self._in_step = False
            tag = next(self._tags) & 0xFFFFFFFF
            tail = b"" if argument is None else _ARGUMENT.pack(argument)
            self._audio.write(
                _OUT, _COMMAND.pack(_COMMAND_MAGIC, tag, answer_size, command) + tail, _TIMEOUT_MS
            )
            answer = self._read(answer_size) if answer_size else b""
            _check(self._read(_ACKNOWLEDGEMENT.size), tag)
            self._in_step = True
        except (usb.core.USBError, ValueError) as error:  # ValueError: pyusb's name for no permission
            raise ControlRefused(
                f"the Kinect's audio device, which holds its motor, does not answer: {error}"
            ) from error
        finally:
            self._lock.release()
        return answer

    def _read(self, size: int) -> bytes:
        answer = bytes(self._audio.read(_IN, _MAX_ANSWER, _TIMEOUT_MS))
        if len(answer) != size:
            raise ControlRefused(f"the Kinect's audio device answers {len(answer)} bytes, not {size}")
        return answer

    def _drop_stale_answers(self) -> None:
        """To commands that were given up, or another program's; with the device opened anew."""
        import usb.core
        import usb.util

        usb.util.dispose_resources(self._audio)  # libfreenect may have reset it since
        with suppress(usb.core.USBTimeoutError):
            for _ in range(_MAX_STALE):
                self._audio.read(_IN, _MAX_ANSWER, _STALE_MS)


def _check(acknowledgement: bytes, tag: int) -> None:
    magic, acknowledged, status = _ACKNOWLEDGEMENT.unpack(acknowledgement)
    if magic != _ACKNOWLEDGEMENT_MAGIC or acknowledged != tag:
        raise ControlRefused("the Kinect's audio device answers something else than it was asked")
    if status:
        raise ControlRefused(f"the Kinect's audio device does not do it: status {status}")
