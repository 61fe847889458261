"""Which way is down, by the accelerometer beside a Kinect's motor, asked on a thread of its own."""

import logging
import threading
import time
from collections import deque
from collections.abc import Sequence

import numpy as np

from rig_agent.sources.base import ControlRefused
from rig_agent.usb.motor import Motor, Reading
from rig_protocol.gravity import Gravity

COUNTS_PER_G = 819.0  # KXSD9 at ±2 g, and FREENECT_COUNTS_PER_G, of every model

# The sensor's axes are left, up and forward as the Kinect sees it, and at rest it reads +1 g along what is
# up; a level one y = +819. (Microsoft's SDK 1.8, "Accelerometer", tells the same with the opposite sign;
# signs of x and z as in the roll and pitch of ROS' kinect_aux.) Down in the colour camera's axes,
# right, down and forward:
_CAMERA_OF_SENSOR = np.diag([1.0, 1.0, -1.0])

READINGS = 10
_INTERVAL_S = 0.05
_RETRY_S = 1.0
_MAX_AGE_S = 2.0
_STOP_LIMIT_S = 1.0

# Sensitivity is within 3 %, and a unit's offset was 5 % of 1 g (KXSD9 data sheet; ROS' kinect_aux).
_REST_G = (0.85, 1.15)
_SHAKEN_G = 0.03  # standard deviation of one axis; at rest its noise is a tenth

log = logging.getLogger(__name__)


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

    def __init__(self, motor: Motor, interval_s: float = _INTERVAL_S) -> None:
        """Without a motor it feels nothing."""
        self._motor = motor
        self._interval_s = interval_s
        self._felt: tuple[Gravity | None, float] = None, 0.0
        self._readings: deque[Reading] = deque(maxlen=READINGS)
        self._silent = False
        self._stopping = threading.Event()
        # A daemon: a motor that keeps libusb from returning must not keep the program alive.
        self._thread = threading.Thread(target=self._run, name="accelerometer", daemon=True)
        if motor.is_there:
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

    def _run(self) -> None:
        wait_s = 0.0
        while not self._stopping.wait(wait_s):
            wait_s = self._interval_s if self._ask() else _RETRY_S

    def _ask(self) -> bool:
        """Take one reading; False where there is no answer."""
        try:
            self._readings.append(self._motor.feel())
        except ControlRefused as error:
            if not self._silent:
                log.info("no accelerometer: %s", error)
            self._silent = True
            self._readings.clear()
            self._felt = None, 0.0
            return False
        self._silent = False
        self._felt = gravity_of(self._readings), time.monotonic()
        return True
