"""The thread that talks to one Kinect, and what it hands to the reader.

libfreenect has no time-outs: a camera that stops answering blocks the calling thread for ever. All
its calls therefore happen on this thread, and everybody else waits for it with a limit.
"""

import ctypes
import logging
import queue
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future

from rig_agent.sources.base import SourceLost
from rig_agent.sources.frame_pairing import FramePairer, ImagePair, StreamImage
from rig_agent.sources.freenect_device import FreenectDevice, Switches
from rig_agent.sources.libfreenect import ZeroPlane
from rig_protocol.errors import RigError
from rig_protocol.troubleshooting import Topic

# Pairs that wait for the reader: 130 ms at 30 Hz, 3.6 MB.
_QUEUE_LIMIT = 4
# How long one call of libfreenect waits for packets, and so how soon a stop is noticed.
_POLL_S = 0.1

log = logging.getLogger(__name__)

_Order = Callable[[FreenectDevice], bool]


class FreenectThread:
    """Opens the `index`-th Kinect on a thread of its own and streams until stopped or lost."""

    def __init__(self, library: ctypes.CDLL, index: int, switches: Switches) -> None:
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
        self._orders: queue.SimpleQueue[tuple[_Order, Future[bool]]] = queue.SimpleQueue()
        self._thread = threading.Thread(
            target=self._run, args=(library, index, switches), name="freenect", daemon=True
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

    def switch(self, switches: Switches, timeout_s: float, restart: bool = False) -> bool:
        """Make the streams so, or all of them anew, and forget the images before; False as the device.

        SourceLost when the device does not come along within the limit.
        """

        def order(device: FreenectDevice) -> bool:
            taken = (device.restart if restart else device.switch)(switches)
            self._pairer.start_anew(with_depth=switches.depth is not None)
            with self._changed:
                self._pairs.clear()
            return taken

        done: Future[bool] = Future()
        with self._changed:
            if self._error:
                raise self._error
            self._orders.put((order, done))
        try:
            return done.result(timeout_s)
        except TimeoutError as error:
            raise SourceLost(
                f"the camera did not answer within {timeout_s:g} s", Topic.HANGING_KINECT
            ) from error

    def stop(self, timeout_s: float) -> bool:
        """Ask the thread to close the device; False when it is still in libfreenect after the limit."""
        self._stopping = True
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self, library: ctypes.CDLL, index: int, switches: Switches) -> None:
        try:
            self._stream(library, index, switches)
        except RigError as error:
            self._fail(error)
        except Exception as error:  # a thread's last words would otherwise be lost
            log.exception("the thread of libfreenect failed")
            self._fail(RigError(f"the thread of libfreenect failed: {error!r}"))

    def _stream(self, library: ctypes.CDLL, index: int, switches: Switches) -> None:
        device = FreenectDevice(library, index, self._on_image)
        try:
            self._device = device
            self._pairer.start_anew(with_depth=switches.depth is not None)
            device.switch(switches)
            with self._changed:
                self._zero_plane = device.zero_plane()
                self._open = True
                self._changed.notify_all()
            while not self._stopping:
                device.process(_POLL_S)
                self._obey(device)
        finally:
            device.close()

    def _obey(self, device: FreenectDevice) -> None:
        while not self._orders.empty():
            order, done = self._orders.get()
            try:
                taken = order(device)
            except RigError as error:
                done.set_exception(error)
                raise
            done.set_result(taken)

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
            while not self._orders.empty():
                self._orders.get()[1].set_exception(error)
            self._changed.notify_all()
