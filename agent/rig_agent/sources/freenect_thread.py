"""The thread that talks to one Kinect, and what it hands to the reader.

libfreenect has no time-outs: a camera that stops answering blocks the calling thread for ever. All
its calls therefore happen on this thread, and everybody else waits for it with a limit.
"""

import ctypes
import logging
import threading
from collections import deque

from rig_agent.sources.base import SourceLost
from rig_agent.sources.frame_pairing import FramePairer, ImagePair, StreamImage
from rig_agent.sources.freenect_device import FreenectDevice
from rig_agent.sources.libfreenect import ZeroPlane
from rig_protocol.errors import RigError
from rig_protocol.troubleshooting import Topic

# Pairs that wait for the reader: 130 ms at 30 Hz, 3.6 MB.
_QUEUE_LIMIT = 4
# How long one call of libfreenect waits for packets, and so how soon a stop is noticed.
_POLL_S = 0.1

log = logging.getLogger(__name__)


class FreenectThread:
    """Opens the `index`-th Kinect on a thread of its own and streams until stopped or lost."""

    def __init__(self, library: ctypes.CDLL, index: int) -> None:
        """Start the thread; `wait_until_open` says how it went."""
        self._changed = threading.Condition()
        self._pairs: deque[ImagePair] = deque()
        self._pairer = FramePairer()
        self._open = False
        self._zero_plane: ZeroPlane | None = None
        self._error: RigError | None = None
        self._stopping = False
        self._overrun = 0
        self._device: FreenectDevice | None = None
        self._thread = threading.Thread(
            target=self._run, args=(library, index), name="freenect", daemon=True
        )  # a daemon, because a thread that hangs in libfreenect must not keep the program alive
        self._thread.start()

    @property
    def counters(self) -> dict[str, int]:
        """Images without a partner, pairs that nobody fetched in time, images of unknown wholeness."""
        device = self._device
        return {
            "unpaired": self._pairer.unpaired,
            "overrun": self._overrun,
            "unreported": device.damage.unreported if device else 0,
        }

    def wait_until_open(self, timeout_s: float) -> ZeroPlane | None:
        """The device's factory data once it streams; SourceLost when it does not within the limit."""
        with self._changed:
            self._changed.wait_for(lambda: self._open or self._error, timeout_s)
            if self._error:
                raise self._error
            if not self._open:
                raise SourceLost(
                    f"the camera did not answer within {timeout_s:g} s of being opened", Topic.HANGING_KINECT
                )
            return self._zero_plane

    def next_pair(self, timeout_s: float) -> ImagePair | None:
        """The oldest waiting pair, or None; SourceLost when there is none and the device is gone."""
        with self._changed:
            self._changed.wait_for(lambda: self._pairs or self._error, timeout_s)
            if self._pairs:
                return self._pairs.popleft()
            if self._error:
                raise self._error
            return None

    def stop(self, timeout_s: float) -> bool:
        """Ask the thread to close the device; False when it is still in libfreenect after the limit."""
        self._stopping = True
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self, library: ctypes.CDLL, index: int) -> None:
        try:
            self._stream(library, index)
        except RigError as error:
            self._fail(error)
        except Exception as error:  # a thread's last words would otherwise be lost
            log.exception("the thread of libfreenect failed")
            self._fail(RigError(f"the thread of libfreenect failed: {error!r}"))

    def _stream(self, library: ctypes.CDLL, index: int) -> None:
        device = FreenectDevice(library, index, self._on_image)
        try:
            self._device = device
            device.start()
            with self._changed:
                self._zero_plane = device.zero_plane()
                self._open = True
                self._changed.notify_all()
            while not self._stopping:
                device.process(_POLL_S)
        finally:
            device.close()

    def _on_image(self, image: StreamImage) -> None:
        pair = self._pairer.add(image)
        if pair is None:
            return
        with self._changed:
            self._pairs.append(pair)
            if len(self._pairs) > _QUEUE_LIMIT:
                self._pairs.popleft()
                self._overrun += 1
            self._changed.notify_all()

    def _fail(self, error: RigError) -> None:
        with self._changed:
            self._error = error
            self._changed.notify_all()
