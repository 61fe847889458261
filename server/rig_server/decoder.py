"""From what crossed the wire to frames, on threads of their own."""

import logging
import threading
from collections import Counter, deque
from collections.abc import Callable

import cv2

from rig_protocol.codecs import keep_freed_memory, warm_up
from rig_protocol.decoding import decode_frame
from rig_protocol.errors import DataError
from rig_protocol.frames import EncodedFrame, RgbdFrame

logger = logging.getLogger(__name__)


class FrameDecoder:
    """Decodes on `threads` threads and calls `deliver` there, each camera's frames in order.

    A camera's frames are decoded one after another, different cameras' at the same time: decoding runs
    without the interpreter's lock. At most `capacity` frames wait; the default is a tenth of a second
    of twelve cameras at 30 Hz, beyond which the server does not keep up and old frames lose their worth.
    """

    def __init__(
        self,
        deliver: Callable[[RgbdFrame], None],
        *,
        threads: int = 2,
        capacity: int = 36,
        demosaic: bool = False,
    ) -> None:
        """Starts the threads; the first time on a machine it compiles for some seconds."""
        if threads < 1 or capacity < 1:
            raise ValueError(f"threads {threads} and capacity {capacity} must be positive")
        warm_up()
        keep_freed_memory()
        if demosaic:  # one image a call is too little for OpenCV's own threads, which take turns with ours
            cv2.setNumThreads(1)
        self._deliver = deliver
        self._capacity = capacity
        self._demosaic = demosaic
        self._waiting: deque[EncodedFrame] = deque()
        self._busy: set[int] = set()
        self._changed = threading.Condition()
        self._closed = False
        self._dropped: Counter[int] = Counter()
        self._undecodable: Counter[int] = Counter()
        self._threads = [
            threading.Thread(target=self._run, name=f"decoder-{i}", daemon=True) for i in range(threads)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def waiting(self) -> int:
        """Frames that wait for a thread."""
        return len(self._waiting)

    @property
    def dropped_by_camera(self) -> Counter[int]:
        """Frames that gave way to newer ones."""
        with self._changed:
            return self._dropped.copy()

    @property
    def undecodable_by_camera(self) -> Counter[int]:
        """Frames whose payload was malformed."""
        with self._changed:
            return self._undecodable.copy()

    @property
    def dropped(self) -> int:
        """Frames of all cameras that gave way to newer ones."""
        return self.dropped_by_camera.total()

    @property
    def undecodable(self) -> int:
        """Frames of all cameras whose payload was malformed."""
        return self.undecodable_by_camera.total()

    def submit(self, frame: EncodedFrame) -> None:
        """Queue a frame; never waits. When the queue is full the oldest frame of all is dropped."""
        with self._changed:
            if self._closed:
                return
            if len(self._waiting) == self._capacity:
                self._dropped[self._waiting.popleft().camera_id] += 1
            self._waiting.append(frame)
            self._changed.notify()

    def close(self) -> None:
        """Forget the frames that wait, and return when no `deliver` runs any more; safe to repeat."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join()

    def _run(self) -> None:
        while (frame := self._take()) is not None:
            try:
                self._deliver(decode_frame(frame, self._demosaic))
            except DataError as error:
                with self._changed:
                    self._undecodable[frame.camera_id] += 1
                logger.debug("camera %d, frame %d: %s", frame.camera_id, frame.sequence, error)
            except Exception:  # the thread's boundary: a bug costs this frame, loudly, and not the others
                logger.exception("camera %d, frame %d is lost", frame.camera_id, frame.sequence)
            finally:
                with self._changed:
                    self._busy.discard(frame.camera_id)

    def _take(self) -> EncodedFrame | None:
        """Wait for the oldest frame of a camera that no thread works on; None when closed."""
        with self._changed:
            while not self._closed:
                for index, frame in enumerate(self._waiting):
                    if frame.camera_id not in self._busy:
                        del self._waiting[index]
                        self._busy.add(frame.camera_id)
                        return frame
                self._changed.wait()
            return None
