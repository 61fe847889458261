"""Any depth camera that OpenNI2 knows, and .oni recordings: depth in millimetres, colour as BGR.

For a Kinect v1 the freenect source is the better one: it has raw disparity, Bayer colour, and flags frames
that lost packets. OpenNI2 tells nothing of lost packets: no frame of this source is ever flagged.
"""

import logging
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Literal, Self, cast

from pydantic import Field

from rig_agent.sources.base import ControlRefused, ControlValue, SourceDescription, SourceLost
from rig_agent.sources.device_clock import DeviceClock
from rig_agent.sources.frame_pairing import FramePairer, StreamImage
from rig_agent.sources.oni_file import check_recording
from rig_agent.sources.openni_device import DeviceImage, OpenniDevice, watch
from rig_agent.sources.openni_library import initialise, open_device, open_recording, reason
from rig_agent.sources.openni_time import PlaybackClock, TimestampUnit
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import ImageU8, ImageU16, RgbdFrame
from rig_protocol.settings import Settings
from rig_protocol.troubleshooting import Topic

_POLL_S = 0.1  # how soon a device that goes is noticed

log = logging.getLogger(__name__)


class Openni2Settings(Settings):
    """Which device or recording, and what of it."""

    recording: Path | None = Field(None, examples=[Path("recordings/office.oni")])
    """.oni file to play, over and over; unset: a live device."""
    playback: Literal["real_time", "as_fast_as_read"] = "real_time"
    """A recording's frames at the pace of their stamps, or as fast as they are read and encoded."""
    uri: str | None = Field(None, min_length=1, examples=["freenect://0"])
    """Device, as OpenNI2 names it; unset: the only one of this machine."""
    serial: str | None = Field(None, min_length=1, examples=["1201010123"])
    """Serial number of the device, where its driver tells one (FreenectDriver does not)."""
    registered: bool = False
    """Depth on the colour camera's pixel grid: a device is told to; a recording is as it was recorded."""
    redist: Path | None = Field(None, examples=[Path("/opt/OpenNI2/Redist")])
    """Folder that holds libOpenNI2 and OpenNI2/Drivers; unset: the system's."""
    timeout_s: float = Field(3.0, ge=0.5, le=60)
    """A device that delivers nothing for so long is taken as lost and opened anew."""


class Openni2Source:
    """A FrameSource on one OpenNI2 device or recording, streaming from the moment it exists."""

    def __init__(self, settings: Openni2Settings) -> None:
        """Load OpenNI2, open and configure the device.

        ConfigurationError for a missing library, an unclear choice or what the device cannot do, DataError
        for a torn or foreign recording, SourceLost for a device that is absent, busy or fails.
        """
        if sum(choice is not None for choice in (settings.recording, settings.uri, settings.serial)) > 1:
            raise ConfigurationError("give only one of `recording`, `uri` and `serial` in [openni2]")
        if settings.recording is not None:
            check_recording(settings.recording)
        self._settings = settings
        self._gone = threading.Event()
        self._streaming = False
        self._openni2: ModuleType | None = initialise(settings.redist)
        try:
            self._device = self._open(self._openni2)
            self._description = _describe(self._device)
            self._device.start()
            self._streaming = True
        except self._openni2.OpenNIError as error:
            self.close()
            raise self._failure(f"it cannot be set up: {reason(error)}") from error
        except BaseException:
            self.close()
            raise
        self._pairer = FramePairer()
        self._unit = TimestampUnit(self._description.fps)
        self._clock = DeviceClock()
        self._playback = PlaybackClock(self._description.fps, time.monotonic_ns)
        self._waiting: RgbdFrame | None = None
        self._silent_s = 0.0  # spent in waiting since the last frame
        self._sequence = self._overrun = self._last_index = 0
        log.info("%s streams; OpenNI2 cannot tell which frames lost packets", self._device.uri)

    @property
    def counters(self) -> Mapping[str, int]:
        """`unpaired` images without a partner, `overrun` frames of a live device that nobody read in time."""
        return {"unpaired": self._pairer.unpaired, "overrun": self._overrun}

    def describe(self) -> SourceDescription:
        """The device; its camera model is the default of its type."""
        return self._description

    def read(self, timeout_s: float) -> RgbdFrame | None:
        """The next frame; a live one is stamped by the device's clock, a recorded one with when it is due.

        SourceLost when the device is gone or has sent no frame for the settings' time-out, DataError for a
        recording that OpenNI2 cannot play.
        """
        end_s = time.monotonic() + timeout_s
        while self._waiting is None:
            began_s = time.monotonic()
            if began_s >= end_s:
                return None
            self._waiting = self._collect(min(end_s - began_s, _POLL_S))
            self._silent_s = 0.0 if self._waiting else self._silent_s + time.monotonic() - began_s
            if self._silent_s > self._settings.timeout_s:
                raise self._failure(f"it has sent no frame for {self._settings.timeout_s:g} s")
        if not self._is_due(end_s):
            return None
        frame, self._waiting = self._waiting, None
        return frame

    def control(self, name: str, value: ControlValue) -> str:
        """There is nothing to set: ControlRefused."""
        raise ControlRefused(f"the openni2 source cannot set {name} to {value}")

    def close(self) -> None:
        """Release the device and shut OpenNI2 down; harmless when already closed."""
        openni2, self._openni2 = self._openni2, None
        if openni2 is None:
            return
        if self._streaming:
            self._device.stop()
        openni2.unload()  # closes streams, listener and device

    def __enter__(self) -> Self:
        """The source itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        """Close."""
        self.close()

    def _open(self, openni2: ModuleType) -> OpenniDevice:
        settings = self._settings
        if settings.recording is not None:
            opened = open_recording(openni2, settings.recording)
        else:
            opened = open_device(openni2, settings.uri, settings.serial)
        device = OpenniDevice(openni2, opened, settings.registered)
        if settings.recording is None:
            self._listener = watch(openni2, device.uri, self._gone)
        return device

    def _collect(self, wait_s: float) -> RgbdFrame | None:
        """The frame that the next image completes, if one comes and does."""
        if self._openni2 is None or self._gone.is_set():
            what = "it is gone (cable or power?)" if self._openni2 else "it is closed"
            raise self._failure(what, Topic.NO_KINECT)
        try:
            arrived = self._device.next_image(wait_s)
        except self._openni2.OpenNIError as error:
            raise self._failure(f"it delivers no more: {reason(error)}") from error
        if arrived is None:
            return None
        self._count_overrun(arrived)
        known = self._unit.is_known
        ticks = self._unit.ticks(arrived.stream, arrived.timestamp, arrived.index)
        if ticks is None:
            return None
        if not known:
            log.info("%s counts time in %s", self._device.uri, self._unit.name)
        image = StreamImage(arrived.stream, ticks, arrived.arrival_ns, arrived.image, damaged=False)
        if len(self._device.streams) == 1:
            return self._frame(*((image, None) if image.stream == "depth" else (None, image)))
        pair = self._pairer.add(image)
        return self._frame(pair.depth, pair.video) if pair else None

    def _count_overrun(self, image: DeviceImage) -> None:
        if self._settings.recording is not None or image.stream != min(self._device.streams):
            return
        if self._last_index:
            self._overrun += max(image.index - self._last_index - 1, 0)
        self._last_index = image.index

    def _frame(self, depth: StreamImage | None, video: StreamImage | None) -> RgbdFrame:
        timestamp_ns, uncertainty_ns = self._stamp(depth or cast(StreamImage, video))
        self._sequence += 1
        return RgbdFrame(
            camera_id=0,
            sequence=self._sequence - 1,
            timestamp_ns=timestamp_ns,
            uncertainty_ns=uncertainty_ns,
            color=cast(ImageU8, video.image) if video else None,
            depth_mm=cast(ImageU16, depth.image) if depth else None,
            depth_frame="color" if self._settings.registered else "depth",
        )

    def _stamp(self, image: StreamImage) -> tuple[int, int]:
        if self._settings.recording is None:
            return self._clock.stamp(image.ticks, image.arrival_ns)
        if self._settings.playback == "real_time":
            return self._playback.due_ns(image.ticks), 0
        return image.arrival_ns, 0

    def _is_due(self, end_s: float) -> bool:
        """Wait for a recorded frame's time, or for the end; False when it is not yet there."""
        if self._settings.recording is None or self._waiting is None:
            return True
        wait_s = self._waiting.timestamp_ns / 1e9 - time.monotonic()
        if wait_s > 0:
            time.sleep(min(wait_s, max(end_s - time.monotonic(), 0.0)))
        return self._waiting.timestamp_ns <= time.monotonic_ns()

    def _failure(self, what: str, topic: Topic = Topic.NO_FRAMES) -> SourceLost | DataError:
        """A device may come back; a recording does not mend."""
        if self._settings.recording is not None:
            return DataError(f"{self._settings.recording} cannot be played: {what}")
        name = self._settings.uri or self._settings.serial or "the OpenNI2 device"
        return SourceLost(f"{name}: {what}", topic)


def _describe(device: OpenniDevice) -> SourceDescription:
    return SourceDescription(
        serial=device.serial,
        port_path=None,
        model=device.camera_model(),
        fps=device.fps,
        color_image=device.color_image,
        depth_image="depth_mm" if "depth" in device.streams else None,
    )
