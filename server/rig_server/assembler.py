"""The synchroniser among threads: decoders put frames in, whoever iterates the rig takes sets out."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.synchroniser import IncompleteSet, Synchroniser
from rig_server.receiver import rig_time_ns

# Sets that wait for a slow consumer: 11 MB each, and more would only make what it gets older.
_MAX_READY = 4
# Sets that rate and spread are taken from: two seconds at 30 Hz.
_RECENT = 60


@dataclass(frozen=True, slots=True)
class SetRecord:
    """What is remembered of a set that went out.

    `received_ns`: rig time at which the last datagram of its last frame was here; None where no frame
    crossed a network. `delivered_ns`: rig time at which the set could be taken.
    """

    delivered_ns: int
    spread_ns: int
    missing: tuple[int, ...]
    uncertainty_ns: int = 0
    received_ns: int | None = None

    @classmethod
    def of(cls, panorama: PanoramicFrame, delivered_ns: int) -> "SetRecord":
        """What is worth remembering of a set."""
        frames = [frame for frame in panorama.frames.values() if frame is not None]
        received_ns = [frame.received_ns for frame in frames if frame.received_ns is not None]
        return cls(
            delivered_ns,
            panorama.spread_ns,
            panorama.missing,
            panorama.uncertainty_ns,
            max(received_ns, default=None),
        )


class Assembler:
    """Guards a synchroniser with a lock and keeps the sets that nobody took yet, the newest few.

    Overdue sets go out when a frame comes or while somebody waits in `next_panorama`: no thread of its own.
    When nobody waits and no frame comes they go out at the next call. `on_set` is called for every set that
    goes out, on whichever thread that happens; it must not block.
    """

    def __init__(self, synchroniser: Synchroniser, on_set: Callable[[SetRecord], None] | None = None) -> None:
        self._synchroniser, self._on_set = synchroniser, on_set
        self._set_ready = threading.Condition()
        self._ready: deque[PanoramicFrame] = deque()
        self._recent: deque[SetRecord] = deque(maxlen=_RECENT)
        self.overrun = 0  # sets that nobody took in time

    def camera_joined(self, camera_id: int, fps: float) -> None:
        """Sets wait for this camera from now on."""
        with self._set_ready:
            self._synchroniser.camera_joined(camera_id, fps)

    def camera_left(self, camera_id: int) -> None:
        """Sets no longer wait for this camera."""
        with self._set_ready:
            self._synchroniser.camera_left(camera_id)
            self._set_ready.notify(self._collect(rig_time_ns()))

    def add(self, frame: RgbdFrame) -> None:
        """Take a decoded frame; called from any thread."""
        with self._set_ready:
            now_ns = rig_time_ns()
            self._synchroniser.add(frame, now_ns)
            self._set_ready.notify(self._collect(now_ns))

    def next_panorama(self, timeout_s: float) -> PanoramicFrame | None:
        """The next set, waiting for it up to `timeout_s`; None when none came."""
        with self._set_ready:
            now_ns = rig_time_ns()
            until_ns = now_ns + int(timeout_s * 1e9)
            while not (self._collect(now_ns) or self._ready):
                if now_ns >= until_ns:
                    return None
                self._set_ready.wait((min(until_ns, self._overdue_ns(now_ns)) - now_ns) / 1e9)
                now_ns = rig_time_ns()
            panorama = self._ready.popleft()
            if self._ready:
                self._set_ready.notify()
            return panorama

    def late(self, camera_id: int) -> int:
        """Frames of one camera that came after their set had gone."""
        return self._synchroniser.late(camera_id)

    @property
    def complete(self) -> int:
        """Complete sets so far."""
        return self._synchroniser.counters.complete

    @property
    def partial(self) -> int:
        """Partial sets so far; under the policy latest those in which a camera has no frame young enough."""
        return self._synchroniser.counters.partial

    @property
    def incomplete(self) -> int:
        """Sets that did not go out because they lacked a camera; the policy strict only."""
        return self._synchroniser.counters.incomplete

    @property
    def skipped(self) -> int:
        """Frames left out: a tighter set was possible, too many waited, or their set was incomplete."""
        return self._synchroniser.counters.skipped

    @property
    def repeated(self) -> int:
        """Frames that went out once more; the policy latest only."""
        return self._synchroniser.counters.repeated

    @property
    def implausible(self) -> int:
        """Frames whose time cannot be true."""
        return self._synchroniser.counters.implausible

    @property
    def waiting(self) -> int:
        """Frames that wait for their set."""
        return self._synchroniser.waiting

    @property
    def ready(self) -> int:
        """Sets that nobody took yet."""
        return len(self._ready)

    @property
    def recent(self) -> tuple[SetRecord, ...]:
        """The last sets that went out, oldest first."""
        with self._set_ready:
            return tuple(self._recent)

    @property
    def recent_incomplete(self) -> tuple[IncompleteSet, ...]:
        """The last sets that did not go out, oldest first."""
        with self._set_ready:
            return tuple(self._synchroniser.incomplete)

    def _overdue_ns(self, now_ns: int) -> int:
        """When a set may become overdue, be its first frame here or not: a frame alone wakes nobody."""
        due_ns = self._synchroniser.next_timeout_ns()
        # A set that became overdue since it was last collected goes out at once.
        return now_ns + self._synchroniser.longest_wait_ns if due_ns is None else max(due_ns, now_ns)

    def _collect(self, now_ns: int) -> int:
        """Move the sets that may go out to those that can be taken; how many."""
        count = 0
        while (panorama := self._synchroniser.next_panorama(now_ns)) is not None:
            if len(self._ready) == _MAX_READY:
                self._ready.popleft()
                self.overrun += 1
            self._ready.append(panorama)
            record = SetRecord.of(panorama, now_ns)
            self._recent.append(record)
            if self._on_set is not None:
                self._on_set(record)
            count += 1
        return count
