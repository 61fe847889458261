"""The recorder: frames and what belongs to them onto the disk, behind a queue, so that a camera never waits.

For the shells of agent and server, which run it in a thread of theirs: lock and clock are handed to it.
"""

import contextlib
import logging
import shutil
from collections import Counter, deque
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from pydantic import Field

from rig_protocol.errors import RigError
from rig_protocol.frames import EncodedFrame
from rig_protocol.recording_format import ClockReading, DroppedFrames, Entry
from rig_protocol.settings import Settings
from rig_protocol.take_file import TakeFile

logger = logging.getLogger(__name__)

_FLUSH_NS = 500_000_000  # a kill loses what came since: one second at most, with a busy machine's delay
_MIB = 1 << 20
_MAX_WAITING = 1 << 14  # frames and sets, however small: half a minute of twelve cameras


class TakeSettings(Settings):
    """How a take is written."""

    part_gib: float = Field(16.0, gt=0, le=1024)
    """Size from which on the recording goes on in another file: FILE.001.mcap, FILE.002.mcap, ..."""
    keep_free_mib: int = Field(64, ge=0, le=1 << 30)
    """Room on the disk that a recording leaves: where there is less, it ends in order."""
    queue_mib: int = Field(256, ge=8, le=1 << 20)
    """Memory for frames that wait for a slow disk; what does not fit is dropped, and told in the file."""


@dataclass(frozen=True, slots=True)
class RecordingStatus:
    """A recording: for how long, what stands in the file, what the disk was too slow for, and the room left.

    `ended` says why it ended before it was stopped.
    """

    path: Path
    seconds: float = 0.0
    frames: int = 0
    bytes: int = 0
    dropped: int = 0
    waiting_bytes: int = 0
    free_bytes: int = 0
    ended: str | None = None

    @property
    def bytes_per_s(self) -> float:
        """Mean rate since it began."""
        return self.bytes / self.seconds if self.seconds > 0 else 0.0


@dataclass(frozen=True, slots=True)
class TakeContext:
    """What a recorder asks for beside the frames, on its own thread.

    `documents`: what is to be attached, by name, as it is now; `cameras`: counts for the manifest; `reading`:
    the take's clock against others, now; `clock`: its name (docs/recording.md), None where it has none;
    `moment`: UTC in words (ISO 8601) and that clock, at one moment; default: now, by this machine.
    """

    documents: Callable[[], Mapping[str, Any]] = dict
    cameras: Callable[[], Mapping[str, Mapping[str, int]]] = dict
    reading: Callable[[], ClockReading | None] = lambda: None
    clock: str | None = None
    moment: Callable[[], tuple[str, int]] | None = None


class Changed(AbstractContextManager[bool], Protocol):
    """A condition variable: `threading.Condition`."""

    def notify(self, n: int = 1) -> None:
        """Wake who waits; the lock is held."""
        ...

    def wait(self, timeout: float | None = None) -> bool:
        """Give the lock away until woken, or for so many seconds."""
        ...


class Recorder:
    """Records what it is given until `stop`; whoever gives it frames never waits.

    A disk that does not keep up costs whole frames, the newest ones, so that what stands in the file has no
    gaps of its own making within a set's time; they are counted here and told in the file. When the disk is
    full or fails, the recording ends with its reason in `status`, and the frames go on without it.
    """

    def __init__(
        self,
        path: Path,
        settings: TakeSettings,
        context: TakeContext,
        changed: Changed,
        now_ns: Callable[[], int],
    ) -> None:
        """Open the file; ConfigurationError when it exists or cannot be written. `now_ns`: its clock."""
        self._path, self._settings, self._context = path, settings, context
        self._now_ns = now_ns
        self._file = TakeFile(path, settings.part_gib * 2**30, now_ns, context.clock, context.moment)
        self._changed = changed  # guards what follows
        self._waiting: deque[Entry] = deque()
        self._waiting_bytes = 0
        self._dropped: Counter[int] = Counter()
        self._untold: dict[int, DroppedFrames] = {}
        self._stopping = False
        self._ended: str | None = None
        self._frames = 0
        self._started_ns = now_ns()
        self._lasted_ns = 0

    def stop(self) -> None:
        """Have `run` write what waits and end the file in order."""
        with self._changed:
            self._stopping = True
            self._changed.notify()

    def add(self, entry: Entry) -> None:
        """Take an entry; a frame for which there is no room is dropped."""
        frame = entry if isinstance(entry, EncodedFrame) else None
        size = 0 if frame is None else _bytes_of(frame)
        with self._changed:
            if self._ended is not None or self._stopping:
                return
            full = self._waiting_bytes + size > self._settings.queue_mib * _MIB
            if not full and len(self._waiting) < _MAX_WAITING:
                self._waiting_bytes += size
                self._waiting.append(entry)
                self._changed.notify()
            elif frame is not None:
                self._drop(frame.camera_id, frame.timestamp_ns)

    def wait_for_room(self, timeout_s: float) -> bool:
        """Wait until half the queue is free, for who need not drop frames; False when it is not in time."""
        with self._changed:
            if self._waiting_bytes > self._settings.queue_mib * _MIB // 2:
                self._changed.wait(timeout_s)
            return self._waiting_bytes <= self._settings.queue_mib * _MIB // 2

    def add_dropped(self, camera_id: int, timestamp_ns: int) -> None:
        """Note a frame that was lost on the way here."""
        with self._changed:
            if self._ended is None and not self._stopping:
                self._drop(camera_id, timestamp_ns)

    def status(self) -> RecordingStatus:
        """How the recording is, at this moment; any thread may ask."""
        free_bytes = _free_bytes(self._path)  # a disk that hangs must not hold up who gives frames
        with self._changed:
            running = self._ended is None and not self._stopping
            lasted_ns = self._now_ns() - self._started_ns if running else self._lasted_ns
            return RecordingStatus(
                path=self._path,
                seconds=lasted_ns / 1e9,
                frames=self._frames,
                bytes=self._file.size,
                dropped=self._dropped.total(),
                waiting_bytes=self._waiting_bytes,
                free_bytes=free_bytes - self._settings.keep_free_mib * _MIB,
                ended=self._ended,
            )

    def run(self) -> None:
        """Write until `stop`, or until there is no room; a thread of its own calls it."""
        try:
            self._write_all()
            self._file.finish(self._context.cameras())
        except (OSError, RigError) as error:  # the next part could not be opened, or the disk failed
            reason = error.strerror if isinstance(error, OSError) else error
            self._end(f"{reason}; `rig-server recover {self._path}` mends the file")
        except Exception as error:  # the thread's boundary: a bug ends the recording, loudly
            logger.exception("recording failed")
            self._end(f"{error!r}; `rig-server recover {self._path}` mends the file")
        finally:
            self._lasted_ns = self._now_ns() - self._started_ns
            with contextlib.suppress(OSError):  # it has been told already
                self._file.close()

    def _drop(self, camera_id: int, time_ns: int) -> None:
        """Note a frame for which there is no room; the lock is held."""
        self._dropped[camera_id] += 1
        before = self._untold.get(camera_id)
        first_ns, count = (time_ns, 0) if before is None else (before.first_ns, before.count)
        self._untold[camera_id] = DroppedFrames(camera_id, count + 1, first_ns, time_ns)

    def _write_all(self) -> None:
        """Until `stop`, or until there is no room."""
        flush_ns, done = self._now_ns() + _FLUSH_NS, False
        while not done:
            done = self._write_waiting(flush_ns)
            if done or self._now_ns() >= flush_ns:
                self._flush()
                flush_ns = self._now_ns() + _FLUSH_NS
            if self._file.full:
                self._end("the disk is full")
            done = done or self._ended is not None

    def _flush(self) -> None:
        """Hand everything to the operating system, and look whether there is room for more."""
        self._tell_dropped()
        reading = self._context.reading()
        if reading is not None:
            self._file.write(reading)
        self._file.flush(self._context.documents())
        if _free_bytes(self._path) < self._settings.keep_free_mib * _MIB:
            self._end(f"less than {self._settings.keep_free_mib} MiB of the disk are free")

    def _write_waiting(self, until_ns: int) -> bool:
        """Write the oldest entry, waiting for one until then; True when none will come any more."""
        with self._changed:
            while not self._waiting:
                wait_ns = until_ns - self._now_ns()
                if self._stopping or wait_ns <= 0:
                    return self._stopping
                self._changed.wait(min(wait_ns, _FLUSH_NS) / 1e9)
            entry = self._waiting[0]
        self._file.write(entry)
        with self._changed:
            self._waiting.popleft()
            if isinstance(entry, EncodedFrame):
                self._waiting_bytes -= _bytes_of(entry)
                self._frames += 1
                self._changed.notify()  # who waits for room: the only one that waits while there is work
        return False

    def _tell_dropped(self) -> None:
        with self._changed:
            untold, self._untold = self._untold, {}
        for dropped in untold.values():
            self._file.write(dropped)

    def _end(self, reason: str) -> None:
        with self._changed:
            if self._ended is not None:
                return
            self._ended = reason
            self._lasted_ns = self._now_ns() - self._started_ns
            self._waiting.clear()
            self._waiting_bytes = 0
        logger.error("recording %s ended: %s; the rest goes on", self._path, reason)


def _bytes_of(frame: EncodedFrame) -> int:
    return sum(len(one.data) for one in (frame.color, frame.depth) if one is not None)


def _free_bytes(path: Path) -> int:
    """Room on the disk of a file, 0 where nobody can tell."""
    try:
        return shutil.disk_usage(path.parent).free
    except OSError:
        return 0
