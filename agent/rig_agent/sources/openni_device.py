"""One open OpenNI2 device or recording: its streams, configured, and their images as this project's."""

import ctypes
import math
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar

import cv2
import numpy as np

from rig_agent.sources.base import ColorImage
from rig_agent.sources.frame_pairing import Stream
from rig_agent.sources.openni_library import serial_of
from rig_protocol.camera import DEFAULT_COLOR, DEFAULT_DEPTH, CameraModel, Intrinsics
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import ImageU8, ImageU16

# OniPixelFormat. The first one of a list that a sensor offers is taken.
_DEPTH_1_MM, _DEPTH_100_UM, _RGB888, _GRAY8 = 100, 101, 200, 202
_FORMATS: dict[Stream, tuple[int, ...]] = {"depth": (_DEPTH_1_MM, _DEPTH_100_UM), "video": (_RGB888, _GRAY8)}
_BYTES_PER_PIXEL = {_DEPTH_1_MM: 2, _DEPTH_100_UM: 2, _RGB888: 3, _GRAY8: 1}
_KINECT_WIDTH, _KINECT_FPS = 640, 30
_REGISTRATION = 5  # a property of devices
_MIRRORING = 7  # properties of streams
_FOV = (1, 2)  # horizontal, vertical
_AS_FAST_AS_READ = -1.0  # a playback speed
_LAST_FRAME_S = 0.3  # ten frames, on a machine that is busy


@dataclass(frozen=True, slots=True, eq=False)
class DeviceImage:
    """An image of a stream; `timestamp` in the driver's unit, `index` counts the stream's frames."""

    stream: Stream
    timestamp: int
    index: int
    arrival_ns: int
    image: ImageU8 | ImageU16


class OpenniDevice:
    """Streams depth and colour, as far as the device has them, from `start` until OpenNI2 is shut down."""

    def __init__(self, openni2: ModuleType, device: Any, registered: bool) -> None:
        """Configure an open device.

        ConfigurationError when it cannot deliver what is asked for. `registered`: depth on the colour
        camera's grid; a recording is as it is, and told by the operator.
        """
        self._openni2, self._device = openni2, device
        self._streams: dict[Stream, Any] = {}
        self.uri: str = device.get_device_info().uri.decode(errors="replace")
        self.serial = serial_of(device)
        self.is_recording: bool = device.is_file()
        if device.is_file():
            device.playback.set_speed(_AS_FAST_AS_READ)  # the source knows itself when a frame is due
        self._create_streams()
        self._mirrored = {name: _still_mirrored(openni2, stream) for name, stream in self._streams.items()}
        # After the streams: before, FreenectDriver has nothing to register.
        if not device.is_file():
            self._register(registered)
        self.registered = registered

    @property
    def streams(self) -> frozenset[Stream]:
        """What it delivers."""
        return frozenset(self._streams)

    @property
    def fps(self) -> float:
        """Nominal rate of the slower stream."""
        return float(min(stream.get_video_mode().fps for stream in self._streams.values()) or _KINECT_FPS)

    @property
    def color_image(self) -> ColorImage | None:
        """Kind of its colour images."""
        if "video" not in self._streams:
            return None
        return "bgr" if _format_of(self._streams["video"]) == _RGB888 else "grey"

    def camera_model(self) -> CameraModel:
        """Pinholes from the fields of view that the driver states: of its type, not of this unit."""
        color = _intrinsics(self._openni2, self._streams.get("video"), DEFAULT_COLOR)
        if self.registered:
            return CameraModel(color=color, depth=None, T_color_depth=None)
        return CameraModel(color, _intrinsics(self._openni2, self._streams.get("depth"), DEFAULT_DEPTH))

    def start(self) -> None:
        """Images come from now on; OpenNIError when the device does not stream."""
        for stream in self._streams.values():
            stream.start()

    def stop(self) -> None:
        """Stop the streams, before OpenNI2 is shut down.

        Drivers say that they have stopped while a thread of theirs still works on a frame (Dummy's,
        FreenectDriver's); what it works on must not be freed before it is done.
        """
        for stream in self._streams.values():
            stream.stop()
        time.sleep(_LAST_FRAME_S)

    def next_image(self, timeout_s: float) -> DeviceImage | None:
        """The next image of any stream, or None; OpenNIError when the device fails."""
        ready = self._openni2.wait_for_any_stream(list(self._streams.values()), timeout_s)
        if ready is None:
            return None
        arrival_ns = time.monotonic_ns()
        name = next(name for name, stream in self._streams.items() if stream is ready)
        with ready.read_frame() as frame:
            image = _image(frame, self._mirrored[name])
            return DeviceImage(name, frame.timestamp, frame.frameIndex, arrival_ns, image)

    def _create_streams(self) -> None:
        sensors = {"depth": self._openni2.SENSOR_DEPTH, "video": self._openni2.SENSOR_COLOR}
        names: tuple[Stream, ...] = ("depth", "video")
        for name in names:
            sensor = self._device.get_sensor_info(sensors[name])
            if sensor is not None:
                self._streams[name] = self._device.create_stream(sensors[name])
                _choose_mode(self._streams[name], sensor.videoModes, name)
        if not self._streams:
            raise ConfigurationError(f"{self.uri} has neither depth nor colour")

    def _register(self, registered: bool) -> None:
        openni2, device = self._openni2, self._device
        mode = openni2.IMAGE_REGISTRATION_DEPTH_TO_COLOR if registered else openni2.IMAGE_REGISTRATION_OFF
        if device.is_image_registration_mode_supported(mode):
            if registered or device.is_property_supported(_REGISTRATION):
                device.set_image_registration_mode(mode)
        elif registered:
            raise ConfigurationError(
                f"{self.uri} cannot register depth to colour: leave out `registered` in [openni2]"
            )


def watch(openni2: ModuleType, uri: str, gone: threading.Event) -> Any:
    """A listener that sets `gone` when the device with this URI goes; OpenNI2's `unload` closes it."""

    class Watch(openni2.DeviceListener):  # type: ignore[name-defined,misc]  # the package ships no types
        # The base class makes its own only after it has registered the callbacks that use them.
        _connected_uris: ClassVar[set[bytes]] = set()
        _disconnected_uris: ClassVar[set[bytes]] = set()

        def on_disconnected(self, info: Any) -> None:
            if info.uri.decode(errors="replace") == uri:
                gone.set()

        def on_state_changed(self, info: Any, state: int) -> None:
            if state == openni2.c_api.OniDeviceState.ONI_DEVICE_STATE_ERROR:
                self.on_disconnected(info)

    return Watch()


def _choose_mode(stream: Any, modes: Sequence[Any], name: Stream) -> None:
    """The best of the sensor's modes: a format that we read, then 640 pixels wide, at 30 a second."""
    formats = _FORMATS[name]
    readable = [mode for mode in modes if int(mode.pixelFormat) in formats]
    if not readable:
        raise ConfigurationError(
            f"the device offers {name} in no format that the rig reads: depth in millimetres, RGB, grey"
        )
    best = min(
        readable,
        key=lambda mode: (
            formats.index(int(mode.pixelFormat)),
            abs(mode.resolutionX - _KINECT_WIDTH),
            abs(mode.fps - _KINECT_FPS),
        ),
    )
    if bytes(best) != bytes(stream.get_video_mode()):  # a recording's mode cannot be set
        stream.set_video_mode(best)


def _still_mirrored(openni2: ModuleType, stream: Any) -> bool:
    """PrimeSense's driver mirrors unless told not to; a recording stays as it was recorded."""
    try:
        if stream.get_mirroring_enabled():
            stream.set_mirroring_enabled(False)
    except openni2.OpenNIError:
        pass  # a recording, or a driver that knows no mirroring
    return bool(_property(openni2, stream, _MIRRORING, ctypes.c_int))


def _property(openni2: ModuleType, stream: Any, number: int, kind: type[Any]) -> Any:
    """A property's value, or None; asked for, because the player denies that it has those that it gives."""
    try:
        return stream.get_property(number, kind).value
    except openni2.OpenNIError:
        return None


def _format_of(stream: Any) -> int:
    return int(stream.get_video_mode().pixelFormat)


def _intrinsics(openni2: ModuleType, stream: Any | None, otherwise: Intrinsics) -> Intrinsics:
    if stream is None:
        return otherwise
    mode = stream.get_video_mode()
    width, height = mode.resolutionX, mode.resolutionY
    horizontal, vertical = (_property(openni2, stream, number, ctypes.c_float) or 0.0 for number in _FOV)
    if 0 < horizontal < math.pi and 0 < vertical < math.pi:
        fx, fy = width / 2 / math.tan(horizontal / 2), height / 2 / math.tan(vertical / 2)
    else:
        fx, fy = otherwise.fx * width / otherwise.width, otherwise.fy * height / otherwise.height
    return Intrinsics(fx, fy, (width - 1) / 2, (height - 1) / 2, width, height)


def _image(frame: Any, mirrored: bool) -> ImageU8 | ImageU16:
    """A copy of the frame's pixels: depth in millimetres, colour as BGR or grey, not mirrored."""
    pixels = int(frame.videoMode.pixelFormat)
    size = _BYTES_PER_PIXEL.get(pixels, 0)
    row_bytes = frame.width * size
    if not (0 < row_bytes <= frame.stride and 0 < frame.stride * frame.height <= frame.dataSize):
        raise DataError(f"OpenNI2 delivers a frame of format {pixels} that is not as large as it says")
    rows = np.frombuffer(frame.get_buffer_as_uint8(), np.uint8, frame.stride * frame.height)
    packed = rows.reshape(frame.height, frame.stride)[:, :row_bytes]
    if pixels == _RGB888:
        color = packed.reshape(frame.height, frame.width, 3)
        return np.asarray(cv2.cvtColor(_upright(color, mirrored), cv2.COLOR_RGB2BGR), np.uint8)
    if pixels == _GRAY8:
        return np.array(_upright(packed, mirrored))
    depth = _upright(packed.view("<u2"), mirrored)
    return np.array(depth) if pixels == _DEPTH_1_MM else _millimetres(depth)


def _millimetres(depth_100_um: ImageU16) -> ImageU16:
    """Rounded; what is nearer than half a millimetre is no measurement."""
    return (depth_100_um // 10 + (depth_100_um % 10 >= 5)).astype(np.uint16)


def _upright(image: Any, mirrored: bool) -> Any:
    return np.ascontiguousarray(image[:, ::-1]) if mirrored else image
