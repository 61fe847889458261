"""One Kinect in a libfreenect context of its own: its streams, its switches, and the damage told.

libfreenect delivers a frame with up to five lost USB packets as good, stale bytes in it. At its log
level SPEW it says before each frame how many packets arrived; that is what marks a frame as damaged.
(Its chunk callbacks would tell too, at the price of 12,000 Python calls a second.)

Images that libfreenect converts come in our own buffers, swapped in the callback: no copy, and torn data
cannot leak between frames. The others (Bayer, packed depth) are copied: see `ImageFormat.converted`.
"""

import ctypes as c
import logging
import re
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rig_agent.sources import libfreenect as fn
from rig_agent.sources.base import SourceLost
from rig_agent.sources.frame_pairing import Stream, StreamImage
from rig_agent.sources.freenect_formats import ImageFormat
from rig_protocol.errors import RigError
from rig_protocol.troubleshooting import Topic

_LIBUSB_INTERRUPTED = -10  # a signal arrived; nothing is wrong
_PACKETS = re.compile(rb"Got (video|depth) frame .*, (\d+)/(\d+) packets")
_SHORT_PACKET = re.compile(rb"\[Stream (70|80)\] Expected ")
_STREAM_OF_FLAG: dict[bytes, Stream] = {b"70": "depth", b"80": "video"}

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Switches:
    """What a Kinect is told about its images; `depth` is None while that stream and the projector are off.

    Auto exposure and white balance are the colour camera's; None for what stays as the Kinect has it.
    """

    video: ImageFormat
    depth: ImageFormat | None
    auto_exposure: bool | None = None
    auto_white_balance: bool | None = None
    mirror: bool = False
    near_mode: bool | None = None

    @property
    def flags(self) -> dict[int, bool]:
        """libfreenect's flags for it."""
        wanted = {
            fn.FLAG_AUTO_EXPOSURE: self.auto_exposure,
            fn.FLAG_AUTO_WHITE_BALANCE: self.auto_white_balance,
            fn.FLAG_MIRROR_VIDEO: self.mirror,
            fn.FLAG_MIRROR_DEPTH: None if self.depth is None else self.mirror,
            fn.FLAG_NEAR_MODE: self.near_mode,
        }
        return {flag: on for flag, on in wanted.items() if on is not None}


class DamageReport:
    """Tells from libfreenect's log whether the frame that it delivers next is whole."""

    def __init__(self) -> None:
        """Nothing read yet."""
        self.unreported = 0
        self._whole: dict[Stream, bool] = {}
        self._short_packets: dict[Stream, int] = {"video": 0, "depth": 0}

    def read(self, line: bytes) -> None:
        """One line of the log."""
        if found := _PACKETS.search(line):
            self._whole["video" if found[1] == b"video" else "depth"] = found[2] == found[3]
        elif found := _SHORT_PACKET.search(line):
            # It belongs to the frame under way, which may be the next but one to be delivered.
            self._short_packets[_STREAM_OF_FLAG[found[1]]] = 2

    def is_damaged(self, stream: Stream) -> bool:
        """Asked once for each delivered frame; an unreported one is counted and taken as whole."""
        whole = self._whole.pop(stream, None)
        self.unreported += whole is None
        short = self._short_packets[stream] > 0
        self._short_packets[stream] -= short
        return short or whole is False


class FreenectDevice:
    """An open Kinect. Every call, and so every `on_image`, happens on the thread that made it.

    `on_image` must return within a few milliseconds: libfreenect holds 32 ms of packets.
    """

    def __init__(self, library: c.CDLL, index: int, on_image: Callable[[StreamImage], None]) -> None:
        """Open the `index`-th camera; SourceLost with libfreenect's own words when it fails."""
        self._library = library
        self.damage = DamageReport()
        self._errors: deque[str] = deque(maxlen=3)
        self._log_callback = fn.LOG_CALLBACK(self._on_log)  # ctypes keeps no reference to what C code holds
        self._context, self._device = c.c_void_p(), c.c_void_p()
        try:
            self._open(index)
        except RigError:
            self.close()
            raise
        self._flags: dict[int, bool] = {}  # as the Kinect has them, as far as it was told
        self._streams = {
            stream: _ImageStream(library, self._device, stream, self.damage.is_damaged, on_image)
            for stream in ("video", "depth")
        }

    def switch(self, switches: Switches) -> bool:
        """Start, stop and set what differs from how it is; False when a flag was not taken.

        A stream that goes on is not disturbed, whatever happens to the other one. SourceLost when the camera
        does not start or stop one.
        """
        self._errors.clear()
        wanted: dict[Stream, ImageFormat | None] = {"depth": switches.depth, "video": switches.video}
        # Infrared in high resolution is refused while depth is on: first all stops, then all starts.
        for stream, form in wanted.items():
            if self._streams[stream].form not in (None, form):
                self._check(self._streams[stream].stop(), f"stop {stream}")
        for stream, form in wanted.items():
            if form is not None and self._streams[stream].form is None:
                self._check(self._streams[stream].start(form), f"start {stream}")
                # A stream starts unmirrored.
                self._flags[fn.FLAG_MIRROR_VIDEO if stream == "video" else fn.FLAG_MIRROR_DEPTH] = False
        if self._errors:  # libfreenect starts and stops without regard to commands that failed: its log tells
            self._check(-1, "switch its streams")
        changed = {flag: on for flag, on in switches.flags.items() if self._flags.get(flag) != on}
        refused = [flag for flag, on in changed.items() if not self._set_flag(flag, on)]
        return not refused

    def restart(self, switches: Switches) -> bool:
        """Stop both streams and start them anew; results are those of `switch`."""
        for stream in self._streams.values():
            if stream.form is not None:
                stream.stop()
        return self.switch(switches)

    def process(self, timeout_s: float) -> None:
        """Wait for packets and deliver what is complete; SourceLost when the device is gone."""
        limit = fn.Timeval(int(timeout_s), int(timeout_s % 1 * 1e6))
        result = self._library.freenect_process_events_timeout(self._context, c.byref(limit))
        if result != _LIBUSB_INTERRUPTED:
            self._check(result, "receive images")

    def zero_plane(self) -> fn.ZeroPlane | None:
        """The unit's factory data."""
        return fn.zero_plane(self._library, self._device)

    def close(self) -> None:
        """Stop both streams, close the device, free the context."""
        if self._device:
            # close_device alone would stop depth only when both are running.
            self._library.freenect_stop_depth(self._device)
            self._library.freenect_stop_video(self._device)
            self._library.freenect_close_device(self._device)
            self._device = c.c_void_p()
        if self._context:
            self._library.freenect_shutdown(self._context)
            self._context = c.c_void_p()

    def _open(self, index: int) -> None:
        library = self._library
        self._check(library.freenect_init(c.byref(self._context), None), "start libfreenect")
        library.freenect_set_log_callback(self._context, self._log_callback)
        library.freenect_set_log_level(self._context, fn.LOG_SPEW)
        library.freenect_select_subdevices(self._context, fn.DEVICE_CAMERA)
        self._check(library.freenect_open_device(self._context, c.byref(self._device), index), "open")

    def _set_flag(self, flag: int, on: bool) -> bool:
        """False for one that the Kinect does not take, which is no reason to do without its images."""
        set_flag = getattr(self._library, "freenect_set_flag", None)
        if set_flag is not None and set_flag(self._device, flag, on) >= 0:  # success may be any of these
            self._flags[flag] = on
            return True
        log.warning("the Kinect does not take flag %#x = %d", flag, on)
        self._flags.setdefault(flag, on)  # what was refused at the start is not asked for at every switch
        return False

    def _check(self, result: int, what: str) -> None:
        if result < 0:
            said = "; ".join(self._errors) or f"error {result}"
            raise SourceLost(f"libfreenect cannot {what}: {said}")

    def _on_log(self, _context: int, level: int, line: bytes) -> None:
        if level >= fn.LOG_SPEW:
            self.damage.read(line)
            return
        text = line.decode(errors="replace").strip()
        if level <= fn.LOG_ERROR:
            self._errors.append(text)
        self.damage.read(line)
        log.log(logging.WARNING if level <= fn.LOG_WARNING else logging.DEBUG, "libfreenect: %s", text)


class _ImageStream:
    """Colour or depth of an open device, in one format at a time."""

    def __init__(
        self,
        library: c.CDLL,
        device: c.c_void_p,
        stream: Stream,
        is_damaged: Callable[[Stream], bool],
        on_image: Callable[[StreamImage], None],
    ) -> None:
        self.form: ImageFormat | None = None  # None while it is stopped
        self._device, self._stream = device, stream
        self._is_damaged, self._on_image = is_damaged, on_image
        self._find_mode = getattr(library, f"freenect_find_{stream}_mode")
        self._set_mode = getattr(library, f"freenect_set_{stream}_mode")
        self._set_buffer = getattr(library, f"freenect_set_{stream}_buffer")
        self._start = getattr(library, f"freenect_start_{stream}")
        self._stop = getattr(library, f"freenect_stop_{stream}")
        self._callback = fn.FRAME_CALLBACK(self._on_frame)
        getattr(library, f"freenect_set_{stream}_callback")(device, self._callback)
        self._buffer: npt.NDArray[Any] | None = None

    def start(self, form: ImageFormat) -> int:
        """Libfreenect's result; RigError when it does not know the format."""
        mode = self._find_mode(form.resolution, form.code)
        if not mode.is_valid or mode.bytes != form.bytes:
            raise RigError(
                f"libfreenect has no {self._stream} of {form.bytes} bytes: use libfreenect 0.5",
                Topic.MISSING_LIBRARY,
            )
        self._buffer = form.empty() if form.converted else None
        # Of the format before it, a buffer may be left that is too small: libfreenect would write on.
        self._set_buffer(self._device, None if self._buffer is None else self._buffer.ctypes.data)
        result: int = self._set_mode(self._device, mode)
        if result >= 0:
            result = self._start(self._device)
        if result >= 0:
            self.form = form
        return result

    def stop(self) -> int:
        """Libfreenect's result."""
        self.form = None
        result: int = self._stop(self._device)
        return result

    def _on_frame(self, _device: int, data: int, ticks: int) -> None:
        arrival_ns, form = time.monotonic_ns(), self.form
        if form is None:
            return  # an image that was complete when the stream stopped
        if self._buffer is None:
            borrowed = (c.c_uint8 * form.bytes).from_address(data)
            image = form.empty()
            image.reshape(-1).view(np.uint8)[:] = np.ctypeslib.as_array(borrowed)
        else:
            image, self._buffer = self._buffer, form.empty()
            self._set_buffer(self._device, self._buffer.ctypes.data)
        self._on_image(StreamImage(self._stream, ticks, arrival_ns, image, self._is_damaged(self._stream)))
