"""The accelerometer of a Kinect 1414, which sits behind its motor's USB device.

Asked through pyusb on a thread of its own and not through libfreenect: that waits for the motor without a
time-out on the thread that must fetch images, and takes the n-th motor of the bus for that of the n-th
camera, which is another Kinect's where models are mixed. Models 1473 and K4W answer through their audio
device, once firmware was loaded into it: nothing is asked of them.
"""

import logging
import struct
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rig_protocol.gravity import Gravity

if TYPE_CHECKING:
    from rig_agent.usb.enumerate import UsbDevice

# Request and answer: `freenect_update_tilt_state` in tilt.c of libfreenect 0.5.
_DEVICE_TO_HOST_VENDOR, _GET_STATE = 0xC0, 0x32
_STATE = struct.Struct(">2x3hbB")  # x, y, z, tilt in half degrees, what the motor does
_MOVING = 4  # of FREENECT_TILT_STATUS_*
COUNTS_PER_G = 819.0  # KXSD9 at ±2 g, and FREENECT_COUNTS_PER_G

# The sensor's axes are left, up and forward as the Kinect sees it, and at rest it reads +1 g along what is
# up; a level one y = +819. (Microsoft's SDK 1.8, "Accelerometer", tells the same with the opposite sign;
# signs of x and z as in the roll and pitch of ROS' kinect_aux.) Down in the colour camera's axes,
# right, down and forward:
_CAMERA_OF_SENSOR = np.diag([1.0, 1.0, -1.0])

READINGS = 10
_INTERVAL_S = 0.05
_TIMEOUT_MS = 250  # an idle motor answers within a millisecond
_RETRY_S = 1.0
_MAX_AGE_S = 2.0
_STOP_LIMIT_S = 1.0

# Sensitivity is within 3 %, and a unit's offset was 5 % of 1 g (KXSD9 data sheet; ROS' kinect_aux).
_REST_G = (0.85, 1.15)
_SHAKEN_G = 0.03  # standard deviation of one axis; at rest its noise is a tenth

log = logging.getLogger(__name__)


class Reading(NamedTuple):
    """One answer: acceleration along the sensor's axes, in counts, and whether the motor turns the Kinect."""

    x: int
    y: int
    z: int
    turning: bool

    @classmethod
    def parse(cls, answer: bytes) -> "Reading":
        """Of the motor's ten bytes."""
        x, y, z, _, status = _STATE.unpack(answer)
        return cls(x, y, z, status == _MOVING)


def gravity_of(readings: Sequence[Reading]) -> Gravity | None:
    """Down in the colour camera's frame, from READINGS readings or more.

    None for fewer, while the Kinect is moved or turned, and where what is felt is nothing like 1 g.
    """
    if len(readings) < READINGS or any(reading.turning for reading in readings):
        return None
    felt_g = np.array([reading[:3] for reading in readings]) / COUNTS_PER_G
    mean_g = felt_g.mean(axis=0)
    if felt_g.std(axis=0).max() > _SHAKEN_G or not _REST_G[0] < np.linalg.norm(mean_g) < _REST_G[1]:
        return None
    return Gravity.along(_CAMERA_OF_SENSOR @ mean_g)


class Accelerometer:
    """Asks one motor all the time, from the moment it exists; `gravity` never waits."""

    def __init__(self, motor: "UsbDevice | None", interval_s: float = _INTERVAL_S) -> None:
        """Without a motor it feels nothing."""
        self._interval_s = interval_s
        self._felt: tuple[Gravity | None, float] = None, 0.0
        self._readings: deque[Reading] = deque(maxlen=READINGS)
        self._silent = False
        self._stopping = threading.Event()
        # A daemon: a motor that keeps libusb from returning must not keep the program alive.
        self._thread = threading.Thread(target=self._run, args=(motor,), name="accelerometer", daemon=True)
        if motor is not None:
            self._thread.start()

    @property
    def gravity(self) -> Gravity | None:
        """Down as felt within the last two seconds; None where nothing was, or the Kinect was moved."""
        gravity, felt_s = self._felt
        return gravity if time.monotonic() - felt_s < _MAX_AGE_S else None

    def close(self) -> None:
        """Stop asking; harmless when already closed."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join(_STOP_LIMIT_S)

    def _run(self, motor: "UsbDevice") -> None:
        import usb.util

        wait_s = 0.0
        while not self._stopping.wait(wait_s):
            wait_s = self._interval_s if self._ask(motor) else _RETRY_S
        usb.util.dispose_resources(motor)

    def _ask(self, motor: "UsbDevice") -> bool:
        """Take one reading; False where there is no answer."""
        import usb.core

        try:
            answer = motor.ctrl_transfer(
                _DEVICE_TO_HOST_VENDOR, _GET_STATE, 0, 0, _STATE.size, timeout=_TIMEOUT_MS
            )
            self._readings.append(Reading.parse(bytes(answer)))
        except (usb.core.USBError, struct.error) as error:
            if not self._silent:
                log.info("no accelerometer: the Kinect's motor does not answer (%s)", error)
            self._silent = True
            self._readings.clear()
            self._felt = None, 0.0
            return False
        self._silent = False
        self._felt = gravity_of(self._readings), time.monotonic()
        return True
