"""The recording sink: encoded frames and the sets made of them onto the disk, in a thread of its own."""

import logging
import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rig_protocol.errors import RigError
from rig_protocol.frames import EncodedFrame, PanoramicFrame
from rig_protocol.recording_format import DroppedFrames, Entry, RecordedSet
from rig_server.config import RecordingSettings
from rig_server.metrics import RecordingStatus
from rig_server.receiver import rig_time_ns
from rig_server.take_file import TakeFile

logger = logging.getLogger(__name__)

_FLUSH_S = 0.5  # a kill loses what came since: one second at most, with a busy machine's delay
_MIB = 1 << 20
_MAX_WAITING = 1 << 14  # frames and sets, however small: half a minute of twelve cameras


class RecordSink:
    """Records between `start` and `stop`; whoever gives it frames and sets never waits.

    A disk that does not keep up costs whole frames, the newest ones, so that what stands in the file has no
    gaps of its own making within a set's time; they are counted here and told in the file. When the disk is
    full or fails, the recording ends with its reason in `status`, and the rig goes on.
    `documents`: what is to be attached, by name, as it is now; `cameras`: counts for the manifest.
    """

    def __init__(
        self,
        path: Path,
        settings: RecordingSettings,
        documents: Callable[[], Mapping[str, Any]],
        cameras: Callable[[], Mapping[str, Mapping[str, int]]],
    ) -> None:
        self._path, self._settings = path, settings
        self._documents, self._cameras = documents, cameras
        self._file: TakeFile | None = None
        self._changed = threading.Condition()  # guards what follows
        self._waiting: deque[Entry] = deque()
        self._waiting_bytes = 0
        self._dropped: Counter[int] = Counter()
        self._untold: dict[int, DroppedFrames] = {}
        self._stopping = False
        self._ended: str | None = None
        self._frames = 0
        self._started_s = time.monotonic()
        self._seconds = 0.0
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Open the file; ConfigurationError when it exists, or cannot be written."""
        file = self._file = TakeFile(self._path, self._settings.part_gib * 2**30)
        self._started_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, args=(file,), name="recorder", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Write what waits and end the file in order; harmless when already stopped."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join()

    def add_frame(self, frame: EncodedFrame) -> None:
        """Take a frame as it came."""
        size = sum(len(one.data) for one in (frame.color, frame.depth) if one is not None)
        with self._changed:
            if self._ended is not None or self._stopping:
                return
            full = self._waiting_bytes + size > self._settings.queue_mib * _MIB
            if full or len(self._waiting) >= _MAX_WAITING:
                self._drop(frame)
                return
            self._waiting_bytes += size
            self._waiting.append(frame)
            self._changed.notify()

    def add_set(self, panorama: PanoramicFrame) -> None:
        """Take a set as it goes out."""
        with self._changed:
            if self._ended is None and not self._stopping and len(self._waiting) < _MAX_WAITING:
                self._waiting.append(RecordedSet.of(panorama, rig_time_ns()))

    def status(self) -> RecordingStatus:
        """How the recording is, at this moment; any thread may ask."""
        with self._changed:
            running = self._ended is None and not self._stopping
            seconds = time.monotonic() - self._started_s if running else self._seconds
            return RecordingStatus(
                path=self._path,
                seconds=seconds,
                frames=self._frames,
                bytes=0 if self._file is None else self._file.size,
                dropped=self._dropped.total(),
                waiting_bytes=self._waiting_bytes,
                free_bytes=_free_bytes(self._path) - self._settings.keep_free_mib * _MIB,
                ended=self._ended,
            )

    def _drop(self, frame: EncodedFrame) -> None:
        """Note a frame for which there is no room; the lock is held."""
        self._dropped[frame.camera_id] += 1
        time_ns, before = frame.timestamp_ns, self._untold.get(frame.camera_id)
        first_ns, count = (time_ns, 0) if before is None else (before.first_ns, before.count)
        self._untold[frame.camera_id] = DroppedFrames(frame.camera_id, count + 1, first_ns, time_ns)

    def _run(self, file: TakeFile) -> None:
        try:
            self._write_all(file)
            file.finish(self._cameras())
        except (OSError, RigError) as error:  # the next part could not be opened, or the disk failed
            reason = error.strerror if isinstance(error, OSError) else error
            self._end(f"{reason}; `rig-server recover {self._path}` mends the file")
        except Exception as error:  # the thread's boundary: a bug ends the recording, loudly
            logger.exception("recording failed")
            self._end(f"{error!r}; `rig-server recover {self._path}` mends the file")
        finally:
            self._seconds = time.monotonic() - self._started_s

    def _write_all(self, file: TakeFile) -> None:
        """Until `stop`, or until there is no room."""
        flush_s, done = time.monotonic() + _FLUSH_S, False
        while not done:
            done = self._write_waiting(file, flush_s)
            if done or time.monotonic() >= flush_s:
                self._tell_dropped(file)
                file.flush(self._documents())
                flush_s = time.monotonic() + _FLUSH_S
                if _free_bytes(self._path) < self._settings.keep_free_mib * _MIB:
                    self._end(f"less than {self._settings.keep_free_mib} MiB of the disk are free")
            if file.full:
                self._end("the disk is full")
            done = done or self._ended is not None

    def _write_waiting(self, file: TakeFile, until_s: float) -> bool:
        """Write the oldest entry, waiting for one until then; True when none will come any more."""
        with self._changed:
            while not self._waiting:
                wait_s = until_s - time.monotonic()
                if self._stopping or wait_s <= 0:
                    return self._stopping
                self._changed.wait(wait_s)
            entry = self._waiting[0]
        file.write(entry)
        with self._changed:
            self._waiting.popleft()
            if isinstance(entry, EncodedFrame):
                self._waiting_bytes -= sum(len(o.data) for o in (entry.color, entry.depth) if o is not None)
                self._frames += 1
        return False

    def _tell_dropped(self, file: TakeFile) -> None:
        with self._changed:
            untold, self._untold = self._untold, {}
        for dropped in untold.values():
            file.write(dropped)

    def _end(self, reason: str) -> None:
        with self._changed:
            if self._ended is not None:
                return
            self._ended = reason
            self._seconds = time.monotonic() - self._started_s
            self._waiting.clear()
            self._waiting_bytes = 0
        logger.error("recording %s ended: %s; the rig goes on", self._path, reason)


def _free_bytes(path: Path) -> int:
    """Room on the disk of a file, 0 where nobody can tell."""
    try:
        return shutil.disk_usage(path.parent).free
    except OSError:
        return 0
