"""The synchroniser among threads: decoders put frames in, whoever iterates the rig takes sets out."""

import threading
from collections import deque
from dataclasses import dataclass

from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_server.receiver import rig_time_ns
from rig_server.synchroniser import Synchroniser

# Sets that wait for a slow consumer: 11 MB each, and more would only make what it gets older.
_MAX_READY = 4
# Sets that rate and spread are taken from: two seconds at 30 Hz.
_RECENT = 60


@dataclass(frozen=True, slots=True)
class SetRecord:
    """What is remembered of a set that went out."""

    delivered_ns: int
    spread_ns: int
    missing: tuple[int, ...]


class Assembler:
    """Guards a synchroniser with a lock and keeps the sets that nobody took yet, the newest few.

    Overdue sets go out when a frame comes or while somebody waits in `next_panorama`: no thread of its own.
    """

    def __init__(self, synchroniser: Synchroniser) -> None:
        self._synchroniser = synchroniser
        self._changed = threading.Condition()
        self._ready: deque[PanoramicFrame] = deque()
        self._recent: deque[SetRecord] = deque(maxlen=_RECENT)
        self.overrun = 0  # sets that nobody took in time

    def camera_joined(self, camera_id: int, fps: float) -> None:
        """Sets wait for this camera from now on."""
        with self._changed:
            self._synchroniser.camera_joined(camera_id, fps)

    def camera_left(self, camera_id: int) -> None:
        """Sets no longer wait for this camera."""
        with self._changed:
            self._synchroniser.camera_left(camera_id)
            self._collect(rig_time_ns())

    def add(self, frame: RgbdFrame) -> None:
        """Take a decoded frame; called from any thread."""
        with self._changed:
            now_ns = rig_time_ns()
            self._synchroniser.add(frame, now_ns)
            self._collect(now_ns)

    def next_panorama(self, timeout_s: float) -> PanoramicFrame | None:
        """The next set, waiting for it up to `timeout_s`; None when none came."""
        until_ns = rig_time_ns() + int(timeout_s * 1e9)
        with self._changed:
            while not self._ready:
                now_ns = rig_time_ns()
                if now_ns >= until_ns:
                    return None
                due_ns = self._synchroniser.next_timeout_ns()
                wake_ns = until_ns if due_ns is None else min(due_ns, until_ns)
                self._changed.wait(max(0, wake_ns - now_ns) / 1e9)
                self._collect(rig_time_ns())
            return self._ready.popleft()

    def late(self, camera_id: int) -> int:
        """Frames of one camera that came after their set had gone."""
        return self._synchroniser.late(camera_id)

    @property
    def complete(self) -> int:
        """Complete sets so far."""
        return self._synchroniser.counters.complete

    @property
    def partial(self) -> int:
        """Partial sets so far."""
        return self._synchroniser.counters.partial

    @property
    def skipped(self) -> int:
        """Frames left out of every set: a tighter one was possible, or too many waited."""
        return self._synchroniser.counters.skipped

    @property
    def implausible(self) -> int:
        """Frames whose time cannot be true."""
        return self._synchroniser.counters.implausible

    @property
    def recent(self) -> tuple[SetRecord, ...]:
        """The last sets, oldest first."""
        with self._changed:
            return tuple(self._recent)

    def _collect(self, now_ns: int) -> None:
        while (panorama := self._synchroniser.next_panorama(now_ns)) is not None:
            if len(self._ready) == _MAX_READY:
                self._ready.popleft()
                self.overrun += 1
            self._ready.append(panorama)
            self._recent.append(SetRecord(now_ns, panorama.spread_ns, panorama.missing))
            self._changed.notify_all()
