"""A real Kinect through libfreenect: Bayer and raw 11-bit disparity as the sensor delivers them.

The ladder when a device misbehaves: `read` raises SourceLost and the agent opens the source anew; a
device that keeps libfreenect from returning has its USB port reset; when that does not help either,
opening raises a plain RigError, the agent ends and its service manager starts a fresh process.
"""

import logging
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Self, cast

from pydantic import Field

from rig_agent.sources.base import ControlRefused, ControlValue, SourceDescription, SourceLost
from rig_agent.sources.device_clock import DeviceClock
from rig_agent.sources.factory_model import camera_model
from rig_agent.sources.frame_pairing import ImagePair
from rig_agent.sources.freenect_thread import FreenectThread
from rig_agent.sources.libfreenect import load_libfreenect
from rig_agent.usb import enumerate as usb_bus
from rig_agent.usb.accelerometer import Accelerometer
from rig_protocol.errors import RigError
from rig_protocol.frames import ImageU8, ImageU16, RgbdFrame
from rig_protocol.settings import Settings
from rig_protocol.troubleshooting import Topic

FPS = 30.0
_STOP_LIMIT_S = 2.0  # stopping takes one poll of 0.1 s and a few commands

log = logging.getLogger(__name__)

_hanging: list[FreenectThread] = []
"""Threads that neither a stop nor a USB reset brought back; each holds its Kinect."""


class FreenectSettings(Settings):
    """Which Kinect, and how patient to be with it."""

    serial: str | None = Field(None, min_length=1, examples=["A00366A00000000A"])
    """Serial number on the Kinect's label; unset: the only Kinect of this machine."""
    port_path: str | None = Field(None, pattern=r"^\d+-\d+(\.\d+)*$", examples=["1-1.2"])
    """USB port that the Kinect's cable is in, as in /sys/bus/usb/devices."""
    library: Path | None = Field(None, examples=[Path("/usr/local/lib/libfreenect.so.0.5")])
    """libfreenect to use; unset: the system's."""
    timeout_s: float = Field(3.0, ge=0.5, le=60)
    """A Kinect that opens or delivers nothing for so long is taken as lost and opened anew."""


class FreenectSource:
    """A FrameSource on one Kinect, streaming from the moment it exists."""

    def __init__(self, settings: FreenectSettings) -> None:
        """Find, open and verify the Kinect.

        ConfigurationError for a missing library or an unclear choice, SourceLost when the Kinect is
        absent, busy, forbidden or silent, RigError when only a new process can help.
        """
        _hanging[:] = [thread for thread in _hanging if not thread.stop(0)]
        if _hanging:
            raise RigError(
                "libfreenect hangs in a Kinect that stopped answering: start the agent anew",
                Topic.HANGING_KINECT,
            )
        library = load_libfreenect(settings.library)
        self._timeout_s = settings.timeout_s
        self._camera, motor = _find(settings)
        self._accelerometer: Accelerometer | None = None
        self._clock = DeviceClock()
        self._sequence = 0
        self._damaged = 0
        self._thread: FreenectThread | None = FreenectThread(library, self._camera.index)
        try:
            self._model = camera_model(self._thread.wait_until_open(self._timeout_s))
            if not usb_bus.is_claimed(self._camera):
                raise SourceLost(f"libfreenect opened another camera than {self._camera}: the bus changed")
        except RigError:
            self.close()
            raise
        self._accelerometer = Accelerometer(motor)
        self._counters = self._thread.counters
        self._last_pair_s = time.monotonic()
        log.info("%s streams; depth model: %s", self._camera, self._model.source)

    @property
    def counters(self) -> Mapping[str, int]:
        """`damaged` frames, `unpaired` images, `overrun` frames nobody read, `unreported` wholeness."""
        if self._thread:
            self._counters = self._thread.counters
        return {"damaged": self._damaged, **self._counters}

    def describe(self) -> SourceDescription:
        """The Kinect and its factory data."""
        return SourceDescription(
            serial=self._camera.serial,
            port_path=self._camera.port_path,
            model=self._model,
            fps=FPS,
            color_image="bayer",
            depth_image="raw",
        )

    def read(self, timeout_s: float) -> RgbdFrame | None:
        """The next frame, stamped with the arrival of its last packet; never waits longer than asked.

        SourceLost when the Kinect is gone or has sent no pair of images for the settings' time-out.
        """
        if self._thread is None:
            raise SourceLost(f"{self._camera} is closed")
        try:
            pair = self._thread.next_pair(timeout_s)
        except SourceLost as error:
            raise SourceLost(f"{self._camera} is gone (cable or power?): {error}", Topic.NO_KINECT) from error
        now_s = time.monotonic()
        if pair is not None:
            self._last_pair_s = now_s
            return self._frame(pair)
        if now_s - self._last_pair_s > self._timeout_s:
            raise SourceLost(f"{self._camera} has sent no images for {self._timeout_s:g} s")
        return None

    def control(self, name: str, value: ControlValue) -> str:
        """There is nothing to set: ControlRefused."""
        raise ControlRefused(f"the Kinect cannot set {name} to {value}")

    def close(self) -> None:
        """Release the Kinect; takes a few seconds at most, whatever the device does."""
        if self._thread is None:
            return
        thread, self._thread = self._thread, None
        self._counters = thread.counters
        if self._accelerometer is not None:
            self._accelerometer.close()
        if thread.stop(_STOP_LIMIT_S):
            return
        log.warning("%s does not answer: resetting its USB port", self._camera)
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

    def _frame(self, pair: ImagePair) -> RgbdFrame:
        timestamp_ns, uncertainty_ns = self._clock.stamp(pair.depth.ticks, pair.depth.arrival_ns)
        damaged = pair.depth.damaged or pair.video.damaged
        self._damaged += damaged
        self._sequence += 1
        return RgbdFrame(
            camera_id=0,
            sequence=self._sequence - 1,
            timestamp_ns=timestamp_ns,
            uncertainty_ns=uncertainty_ns,
            bayer=cast(ImageU8, pair.video.image),
            raw=cast(ImageU16, pair.depth.image),
            damaged=damaged,
            gravity=None if self._accelerometer is None else self._accelerometer.gravity,
        )


def _find(settings: FreenectSettings) -> tuple[usb_bus.KinectCamera, usb_bus.UsbDevice | None]:
    """The camera to open, and the motor of the same Kinect where it has one."""
    devices = usb_bus.usb_devices()
    cameras = usb_bus.kinect_cameras(devices)
    camera = usb_bus.choose_camera(cameras, settings.serial, settings.port_path)
    usb_bus.check_access(camera)
    return camera, usb_bus.motor_beside(camera, devices)
