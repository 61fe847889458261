"""A real Kinect through libfreenect: Bayer and raw 11-bit disparity as the sensor delivers them.

The ladder when a Kinect falls silent, one step for each time-out: restart its streams, open it anew, reset
its USB port, and at last a plain RigError, at which the agent ends and its service manager starts a fresh
process. A Kinect that is gone or cannot be opened is a SourceLost, at which the agent opens the source anew.
"""

import logging
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from pydantic import Field

from rig_agent.sources.base import (
    ColorImage,
    ControlRefused,
    ControlValue,
    SourceDescription,
    SourceLost,
)
from rig_agent.sources.device_clock import DeviceClock
from rig_agent.sources.factory_model import camera_model
from rig_agent.sources.frame_pairing import ImagePair
from rig_agent.sources.freenect_controls import RestartStep, Wishes, degrees, one_of
from rig_agent.sources.freenect_formats import ColorName, DepthName, color_images, disparity
from rig_agent.sources.freenect_thread import FreenectThread
from rig_agent.sources.libfreenect import load_libfreenect
from rig_agent.usb import enumerate as usb_bus
from rig_agent.usb.accelerometer import Accelerometer
from rig_agent.usb.motor import Led, Motor, NoMotor
from rig_protocol.errors import RigError
from rig_protocol.frames import RgbdFrame
from rig_protocol.settings import Settings
from rig_protocol.troubleshooting import Topic

FPS = 30.0
_STOP_LIMIT_S = 2.0  # stopping takes one poll of 0.1 s and a few commands
_COLOR_IMAGE: dict[ColorName, ColorImage] = {"bayer": "bayer", "rgb": "bgr", "ir": "grey"}

COUNTERS = (
    "damaged",
    "unpaired",
    "overrun",
    "unreported",
    "stream_restarts",
    "device_restarts",
    "usb_resets",
)
"""What a source counts: damaged frames, images without partner, pairs that nobody read in time, images whose
wholeness libfreenect did not tell, and the steps of the ladder."""
_LADDER: tuple[RestartStep, ...] = ("stream", "device", "usb")
_COUNTER_OF_STEP: dict[RestartStep, str] = {
    "stream": "stream_restarts",
    "device": "device_restarts",
    "usb": "usb_resets",
}
_WORDS_OF_STEP: dict[RestartStep, str] = {
    "stream": "its streams were restarted",
    "device": "it was opened anew",
    "usb": "its USB port was reset",
}

log = logging.getLogger(__name__)

_hanging: list[FreenectThread] = []
"""Threads that neither a stop nor a USB reset brought back; each holds its Kinect."""
_untold: Counter[str] = Counter()
"""Steps taken for a Kinect that then could not be opened; the next source tells them."""


class FreenectSettings(Settings):
    """Which Kinect, what it is told when it opens, and how patient to be with it."""

    serial: str | None = Field(None, min_length=1, examples=["A00366A00000000A"])
    """Serial number on the Kinect's label; unset: the only Kinect of this machine."""
    port_path: str | None = Field(None, pattern=r"^\d+-\d+(\.\d+)*$", examples=["1-1.2"])
    """USB port that the Kinect's cable is in, as in /sys/bus/usb/devices."""
    library: Path | None = Field(None, examples=[Path("/usr/local/lib/libfreenect.so.0.5")])
    """libfreenect to use; unset: the system's."""
    timeout_s: float = Field(3.0, ge=0.5, le=60)
    """A Kinect that delivers nothing for so long is restarted: its streams, the device, its USB port."""
    color: ColorName = "bayer"
    """The colour camera's images as it takes them, or demosaiced; or the depth camera's infrared images."""
    depth_format: DepthName = "11bit"
    """Whether libfreenect unpacks disparity, or this program does; the same images, at other costs."""
    auto_exposure: bool = True
    """The colour camera adapts to the light; false keeps the exposure that it has."""
    auto_white_balance: bool = True
    """The colour camera adapts to the colour of the light; false keeps what it has."""
    mirror: bool = False
    """Images as a mirror shows them; calibration wants them unmirrored."""
    near_mode: bool = False
    """Depth from 0.4 m on; Kinect for Windows only."""
    led: Led = "green"
    """Light while the Kinect streams; it goes out when the agent ends. 1473 and K4W: with firmware only."""


class FreenectSource:
    """A FrameSource on one Kinect, streaming from the moment it exists."""

    def __init__(self, settings: FreenectSettings) -> None:
        """Find, open and verify the Kinect.

        ConfigurationError for a missing library or an unclear choice, SourceLost when the Kinect is
        absent, busy, forbidden or silent, RigError when only a new process can help.
        """
        self._settings = settings
        self._library = load_libfreenect(settings.library)
        self._wishes = Wishes(
            color=settings.color,
            depth=True,
            depth_format=settings.depth_format,
            auto_exposure=settings.auto_exposure,
            auto_white_balance=settings.auto_white_balance,
            mirror=settings.mirror,
            near_mode=settings.near_mode,
        )
        self._led: Led = settings.led
        self._clock = DeviceClock()
        self._sequence = 0
        self._counts: Counter[str] = Counter()
        self._steps = 0  # of the ladder, since the last images
        self._thread: FreenectThread | None = None
        self._open()

    @property
    def counters(self) -> Mapping[str, int]:
        """What went wrong, and which steps of the ladder were taken: docs/monitoring.md."""
        counts = Counter(dict.fromkeys(COUNTERS, 0))
        counts.update(self._counts)
        counts.update(self._thread.counters if self._thread else {})
        return counts

    def describe(self) -> SourceDescription:
        """The Kinect and its factory data."""
        return SourceDescription(
            serial=self._camera.serial,
            port_path=self._camera.port_path,
            model=self._model,
            fps=FPS,
            color_image=_COLOR_IMAGE[self._wishes.color],
            depth_image="raw",
        )

    def read(self, timeout_s: float) -> RgbdFrame | None:
        """The next frame, stamped with the arrival of its last packet.

        Waits no longer than asked, but for the ladder's steps: seconds each, when nothing has come for the
        settings' time-out. SourceLost when the Kinect is gone, RigError when the ladder is at its end.
        """
        thread = self._thread_of_open_kinect()
        try:
            pair = thread.next_pair(timeout_s)
        except SourceLost as error:
            raise SourceLost(f"{self._camera} is gone (cable or power?): {error}", Topic.NO_KINECT) from error
        if pair is not None:
            self._steps, self._last_sign_s = 0, time.monotonic()
            return self._frame(pair)
        if time.monotonic() - self._last_sign_s > self._settings.timeout_s:
            self._climb()
        return None

    def control(self, name: str, value: ControlValue) -> str:
        """Set what docs/control.md lists; what was done, in words.

        ControlRefused for what this Kinect has not, SourceLost when it did not come back.
        """
        thread = self._thread_of_open_kinect()
        match name:
            case "led":
                led: Led = one_of(Led, name, value)
                shown = self._motor.set_led(led)
                self._led = led
                nearest = "" if shown == led else f", the nearest that a {self._camera.model} has"
                return f"the LED is {shown.replace('_', ' ')}{nearest}"
            case "tilt_deg":
                tilt_deg = self._motor.set_tilt(degrees(name, value))
                return f"the Kinect turns to {tilt_deg:g} degrees above the horizon"
            case "restart":
                return self._restart("stream" if value is True else one_of(RestartStep, name, value))
        wishes = self._wishes.told(name, value, self._camera.model)
        if not thread.switch(wishes.switches(self._camera.model), self._settings.timeout_s):
            raise ControlRefused(f"the Kinect does not take {name} = {str(value).lower()}")
        self._wishes, self._last_sign_s = wishes, time.monotonic()
        return f"{name} is {str(value).lower()}"

    def close(self) -> None:
        """Release the Kinect; takes a few seconds at most, whatever the device does."""
        if self._thread is None:
            return
        thread, self._thread = self._thread, None
        self._counts.update(thread.counters)
        self._accelerometer.close()
        self._motor.close()
        if thread.stop(_STOP_LIMIT_S):
            return
        log.warning("%s does not answer: resetting its USB port", self._camera)
        _untold["usb_resets"] += 1
        usb_bus.reset(self._camera)
        if not thread.stop(_STOP_LIMIT_S):
            _hanging.append(thread)

    def __enter__(self) -> Self:
        """The source itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        """Close."""
        self.close()

    def _open(self) -> None:
        """Find, open and verify; errors are those of the constructor."""
        _hanging[:] = [thread for thread in _hanging if not thread.stop(0)]
        if _hanging:
            raise RigError(
                "libfreenect hangs in a Kinect that stopped answering: start the agent anew",
                Topic.HANGING_KINECT,
            )
        self._camera, self._motor = find_kinect(self._settings)
        # Opening a 1473 or K4W, libfreenect resets and claims the audio device, which holds the motor.
        self._accelerometer = Accelerometer(NoMotor("libfreenect opens the Kinect"))
        switches = self._wishes.switches(self._camera.model)
        self._thread = FreenectThread(self._library, self._camera.index, switches)
        try:
            self._model = camera_model(self._thread.wait_until_open(self._settings.timeout_s))
            if not usb_bus.is_claimed(self._camera):
                raise SourceLost(f"libfreenect opened another camera than {self._camera}: the bus changed")
        except RigError:
            self.close()
            raise
        self._motor.light(self._led)
        self._accelerometer = Accelerometer(self._motor)
        self._counts.update(_untold)
        _untold.clear()
        self._last_sign_s = time.monotonic()
        depth = self._model.raw_model
        log.info("%s streams; z = %.3f m / (%.2f - d)", self._camera, depth.numerator_m, depth.offset)

    def _thread_of_open_kinect(self) -> FreenectThread:
        if self._thread is None:
            raise SourceLost(f"{self._camera} is closed")
        return self._thread

    def _climb(self) -> None:
        """The next step of the ladder for a Kinect that is silent."""
        silent = f"{self._camera} has sent no images for {self._settings.timeout_s:g} s"
        if self._steps == len(_LADDER):
            raise RigError(f"{silent}, whatever was tried: start the agent anew", Topic.NO_FRAMES)
        step = _LADDER[self._steps]
        self._steps += 1
        log.warning("%s; %s", silent, self._restart(step))

    def _restart(self, step: RestartStep) -> str:
        """Take one step, count it and say it; SourceLost when the Kinect does not come back."""
        thread = self._thread_of_open_kinect()
        self._counts[_COUNTER_OF_STEP[step]] += 1
        if step == "stream":
            thread.switch(self._wishes.switches(self._camera.model), self._settings.timeout_s, restart=True)
        else:
            self.close()
            if step == "usb":
                usb_bus.reset(self._camera)
            self._open()
        self._last_sign_s = time.monotonic()
        return _WORDS_OF_STEP[step]

    def _frame(self, pair: ImagePair) -> RgbdFrame:
        timestamp_ns, uncertainty_ns = self._clock.stamp(pair.clocked.ticks, pair.clocked.arrival_ns)
        self._counts["damaged"] += pair.damaged
        self._sequence += 1
        return RgbdFrame(
            camera_id=0,
            sequence=self._sequence - 1,
            timestamp_ns=timestamp_ns,
            uncertainty_ns=uncertainty_ns,
            raw=None if pair.depth is None else disparity(self._wishes.depth_format, pair.depth.image),
            damaged=pair.damaged,
            gravity=self._accelerometer.gravity,
            **color_images(self._wishes.color, pair.video.image),
        )


def find_kinect(settings: FreenectSettings) -> tuple[usb_bus.KinectCamera, Motor]:
    """The camera to open, and the motor of the same Kinect."""
    devices = usb_bus.usb_devices()
    cameras = usb_bus.kinect_cameras(devices)
    camera = usb_bus.choose_camera(cameras, settings.serial, settings.port_path)
    usb_bus.check_access(camera)
    return camera, usb_bus.motor_beside(camera, devices)
