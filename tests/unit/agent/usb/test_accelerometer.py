"""Down from a Kinect's accelerometer: axes, what is refused, a motor that falls silent."""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import usb.core
import usb.util

from rig_agent.usb.accelerometer import COUNTS_PER_G, READINGS, Accelerometer, gravity_of
from rig_agent.usb.motor import NoMotor, Reading
from rig_agent.usb.motor_1414 import Motor1414, parse_state

RNG = np.random.default_rng(3)
LEVEL = (0, 819, 0)


def answer(x: int, y: int, z: int, status: int = 0) -> bytes:
    """Of the motor to request 0x32."""
    axes = b"".join(value.to_bytes(2, "big", signed=True) for value in (x, y, z))
    return bytes(2) + axes + bytes([0, status])


def readings(x: float, y: float, z: float, noise: float = 2.0, count: int = READINGS) -> list[Reading]:
    felt = np.rint(np.array([x, y, z]) + noise * RNG.standard_normal((count, 3))).astype(int)
    return [parse_state(answer(*one.tolist())) for one in felt]


@pytest.mark.parametrize(
    ("counts", "down"),
    [
        ((0, 819, 0), (0, 1, 0)),  # level: down is the image's +y
        ((0, 0, 819), (0, 0, -1)),  # looks at the ceiling: down is behind it
        ((0, 0, -819), (0, 0, 1)),  # looks at the floor
        ((819, 0, 0), (1, 0, 0)),  # its left side up, as in the ring: down is the image's +x
        ((-819, 0, 0), (-1, 0, 0)),
        ((0, -819, 0), (0, -1, 0)),
    ],
)
def test_the_sensors_axes_are_left_up_and_forward(
    counts: tuple[float, float, float], down: tuple[float, float, float]
) -> None:
    gravity = gravity_of(readings(*counts))
    assert gravity is not None
    np.testing.assert_allclose(gravity.down, down, atol=0.01)


def test_readings_are_averaged() -> None:
    gravity = gravity_of(readings(*LEVEL, noise=15, count=1000))
    assert gravity is not None
    assert np.rad2deg(np.arccos(gravity.down[1])) < 0.2  # one reading: 1.5°


@pytest.mark.parametrize(
    "felt",
    [
        readings(*LEVEL, count=READINGS - 1),
        [],
        readings(*LEVEL, noise=80),
        readings(*LEVEL)[:5] + readings(300, 760, 0)[:5],
        readings(0, 0.8 * COUNTS_PER_G, 0),
        readings(0, 1.2 * COUNTS_PER_G, 0),
        readings(0, 0, 0),
        [*readings(*LEVEL), parse_state(answer(*LEVEL, status=4))],
    ],
    ids=["too few", "none", "shaken", "turned", "falling", "pushed", "a dead sensor", "the motor turns it"],
)
def test_what_is_felt_while_the_camera_moves_is_no_gravity(felt: list[Reading]) -> None:
    assert gravity_of(felt) is None


class Motor:
    """A motor that answers what a script says, and then the last of it again."""

    def __init__(self, *script: bytes | Exception) -> None:
        self._script = list(script)
        self._changed = threading.Condition()
        self.asked = 0

    def ctrl_transfer(self, *_request: Any, timeout: int) -> bytes:
        assert 0 < timeout < 1000, "a motor must not be waited for without a limit"
        with self._changed:
            step = self._script.pop(0) if len(self._script) > 1 else self._script[0]
            self.asked += 1
            self._changed.notify_all()
        if isinstance(step, Exception):
            raise step
        return step

    def wait_until_asked(self, times: int) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: self.asked >= times, 10)


@pytest.fixture
def feel(monkeypatch: pytest.MonkeyPatch) -> Callable[[Motor], Accelerometer]:
    monkeypatch.setattr("rig_agent.usb.accelerometer._RETRY_S", 0.001)
    monkeypatch.setattr(usb.util, "dispose_resources", lambda _device: None)
    return lambda motor: Accelerometer(Motor1414(motor), interval_s=0.001)


SILENT = usb.core.USBError("Operation timed out", -7, 110)


def test_a_motor_that_answers_tells_which_way_is_down(feel: Callable[[Motor], Accelerometer]) -> None:
    motor = Motor(answer(*LEVEL))
    accelerometer = feel(motor)
    motor.wait_until_asked(READINGS + 1)
    assert accelerometer.gravity is not None
    accelerometer.close()
    assert accelerometer.gravity is not None  # known for two seconds more


@pytest.mark.parametrize("fault", [SILENT, b"", b"too long for an answer"], ids=str)
def test_a_motor_that_falls_silent_takes_what_was_felt_with_it(
    feel: Callable[[Motor], Accelerometer], fault: bytes | Exception
) -> None:
    motor = Motor(*[answer(*LEVEL)] * (READINGS + 1), fault)
    accelerometer = feel(motor)
    motor.wait_until_asked(READINGS + 3)
    assert accelerometer.gravity is None
    accelerometer.close()


def test_a_motor_that_answers_again_is_heard_again(feel: Callable[[Motor], Accelerometer]) -> None:
    motor = Motor(SILENT, SILENT, answer(*LEVEL))
    accelerometer = feel(motor)
    motor.wait_until_asked(2 + READINGS + 1)
    assert accelerometer.gravity is not None
    accelerometer.close()


def test_what_was_felt_two_seconds_ago_is_forgotten(
    feel: Callable[[Motor], Accelerometer], monkeypatch: pytest.MonkeyPatch
) -> None:
    motor = Motor(answer(*LEVEL))
    accelerometer = feel(motor)
    motor.wait_until_asked(READINGS + 1)
    accelerometer.close()  # as when the driver never returns
    monkeypatch.setattr("rig_agent.usb.accelerometer._MAX_AGE_S", 0.0)
    assert accelerometer.gravity is None


def test_a_kinect_without_motor_feels_nothing() -> None:
    accelerometer = Accelerometer(NoMotor("none is there"))
    assert accelerometer.gravity is None
    accelerometer.close()
