"""Tilt motor, LED and accelerometer of a Kinect, whichever device they sit behind.

Asked through pyusb and not through libfreenect: that waits for the motor without a time-out on the thread
that must fetch images. `enumerate.motor_beside` chooses.
"""

from abc import ABC, abstractmethod
from contextlib import suppress
from typing import Literal, NamedTuple

from rig_agent.sources.base import ControlRefused

Led = Literal["off", "green", "red", "yellow", "blink_green", "blink_red_yellow"]

MAX_TILT_DEG = 27.0  # the motor's range by Microsoft's data sheet; libfreenect would allow 31


class Reading(NamedTuple):
    """One answer: acceleration along the sensor's axes, in counts, and whether the motor turns the Kinect."""

    x: int
    y: int
    z: int
    turning: bool


class Motor(ABC):
    """Of one Kinect. Each call is done or refused within a second or two; ControlRefused says why."""

    is_there = True

    @abstractmethod
    def set_led(self, led: Led) -> Led:
        """Light the LED; what it shows: this, or the nearest that the model has."""

    def set_tilt(self, tilt_deg: float) -> float:
        """Begin to turn to this angle above the horizon, by the Kinect's own sense of gravity.

        Returns the angle, rounded to what the motor takes; turning takes seconds. ControlRefused beyond
        ±MAX_TILT_DEG, or where no motor answers.
        """
        if not -MAX_TILT_DEG <= tilt_deg <= MAX_TILT_DEG:  # false for NaN, too
            raise ControlRefused(f"the motor turns from -{MAX_TILT_DEG:g} to {MAX_TILT_DEG:g} degrees")
        return self._turn(tilt_deg)

    @abstractmethod
    def feel(self) -> Reading:
        """What the accelerometer feels now."""

    def light(self, led: Led) -> None:
        """Show how it goes, where there is something to show it with."""
        with suppress(ControlRefused):  # a motor that is mute or gone is no reason to do without images
            self.set_led(led)

    def close(self) -> None:
        """Put the light out."""
        self.light("off")

    @abstractmethod
    def _turn(self, tilt_deg: float) -> float: ...


class NoMotor(Motor):
    """Of a Kinect where nothing can be asked; refuses everything, in words."""

    is_there = False

    def __init__(self, reason: str) -> None:
        """The reason is the refusal's text."""
        self._reason = reason

    def set_led(self, led: Led) -> Led:  # noqa: ARG002  # none can be shown
        """Refused."""
        raise ControlRefused(self._reason)

    def feel(self) -> Reading:
        """Refused."""
        raise ControlRefused(self._reason)

    def _turn(self, tilt_deg: float) -> float:  # noqa: ARG002  # likewise
        raise ControlRefused(self._reason)
