"""One Kinect in a libfreenect context of its own: Bayer and 11-bit depth, with the damage told.

libfreenect delivers a frame with up to five lost USB packets as good, stale bytes in it. At its log
level SPEW it says before each frame how many packets arrived; that is what marks a frame as damaged.
(Its chunk callbacks would tell too, at the price of 12,000 Python calls a second.)

Depth is unpacked by libfreenect into our buffers, swapped in the callback: no copy, and torn data
cannot leak between frames. Bayer is copied from libfreenect's buffer: it writes the first packet of
the next frame before it delivers a frame whose last packet was lost, so swapping would lose that packet.
"""

import ctypes as c
import logging
import re
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from rig_agent.sources import libfreenect as fn
from rig_agent.sources.base import SourceLost
from rig_agent.sources.frame_pairing import Stream, StreamImage
from rig_protocol.errors import RigError
from rig_protocol.frames import ImageU16
from rig_protocol.troubleshooting import Topic

WIDTH, HEIGHT = 640, 480

_LIBUSB_INTERRUPTED = -10  # a signal arrived; nothing is wrong
_PACKETS = re.compile(rb"Got (video|depth) frame .*, (\d+)/(\d+) packets")
_SHORT_PACKET = re.compile(rb"\[Stream (70|80)\] Expected ")
_STREAM_OF_FLAG: dict[bytes, Stream] = {b"70": "depth", b"80": "video"}

log = logging.getLogger(__name__)


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
        self._on_image = on_image
        self.damage = DamageReport()
        self._errors: deque[str] = deque(maxlen=3)
        self._depth_buffer = _depth_buffer()
        # ctypes keeps no reference to callbacks that C code holds.
        self._callbacks = (
            fn.LOG_CALLBACK(self._on_log),
            fn.FRAME_CALLBACK(self._on_video),
            fn.FRAME_CALLBACK(self._on_depth),
        )
        self._context, self._device = c.c_void_p(), c.c_void_p()
        try:
            self._open(index)
        except RigError:
            self.close()
            raise

    def start(self) -> None:
        """Begin to stream; SourceLost when the camera refuses."""
        _, on_video, on_depth = self._callbacks
        self._library.freenect_set_depth_buffer(self._device, self._depth_buffer.ctypes.data)
        self._library.freenect_set_depth_callback(self._device, on_depth)
        self._library.freenect_set_video_callback(self._device, on_video)
        self._check(self._library.freenect_start_depth(self._device), "start depth")
        self._check(self._library.freenect_start_video(self._device), "start colour")

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
        library.freenect_set_log_callback(self._context, self._callbacks[0])
        library.freenect_set_log_level(self._context, fn.LOG_SPEW)
        library.freenect_select_subdevices(self._context, fn.DEVICE_CAMERA)
        self._check(library.freenect_open_device(self._context, c.byref(self._device), index), "open")
        video = library.freenect_find_video_mode(fn.RESOLUTION_MEDIUM, fn.VIDEO_BAYER)
        depth = library.freenect_find_depth_mode(fn.RESOLUTION_MEDIUM, fn.DEPTH_11BIT)
        if (video.bytes, depth.bytes) != (WIDTH * HEIGHT, 2 * WIDTH * HEIGHT):
            raise RigError(
                "this libfreenect offers no 640×480 Bayer and 11-bit depth: use libfreenect 0.5",
                Topic.MISSING_LIBRARY,
            )
        self._check(library.freenect_set_video_mode(self._device, video), "choose Bayer")
        self._check(library.freenect_set_depth_mode(self._device, depth), "choose 11-bit depth")

    def _check(self, result: int, what: str) -> None:
        if result < 0:
            said = "; ".join(self._errors) or f"error {result}"
            raise SourceLost(f"libfreenect cannot {what}: {said}")

    def _on_depth(self, _device: int, _data: int, ticks: int) -> None:
        arrival_ns = time.monotonic_ns()
        image, self._depth_buffer = self._depth_buffer, _depth_buffer()
        self._library.freenect_set_depth_buffer(self._device, self._depth_buffer.ctypes.data)
        self._on_image(StreamImage("depth", ticks, arrival_ns, image, self.damage.is_damaged("depth")))

    def _on_video(self, _device: int, data: int, ticks: int) -> None:
        arrival_ns = time.monotonic_ns()
        borrowed = (c.c_uint8 * (WIDTH * HEIGHT)).from_address(data)
        image = np.ctypeslib.as_array(borrowed).reshape(HEIGHT, WIDTH).copy()
        self._on_image(StreamImage("video", ticks, arrival_ns, image, self.damage.is_damaged("video")))

    def _on_log(self, _context: int, level: int, line: bytes) -> None:
        if level >= fn.LOG_SPEW:
            self.damage.read(line)
            return
        text = line.decode(errors="replace").strip()
        if level <= fn.LOG_ERROR:
            self._errors.append(text)
        self.damage.read(line)
        log.log(logging.WARNING if level <= fn.LOG_WARNING else logging.DEBUG, "libfreenect: %s", text)


def _depth_buffer() -> ImageU16:
    return np.empty((HEIGHT, WIDTH), np.uint16)
