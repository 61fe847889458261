"""The synchroniser: frames of free-running cameras in, panoramic frames out. Pure: time is an argument.

Twelve Kinects run at one rate with phases of their own and no trigger. Marked on a circle one period
round, their exposures leave gaps; the tightest set starts after the widest gap. The oldest frame that
waits for each camera (its head) is a candidate; where starting a frame later for the earliest cameras
would be tighter by more than the hysteresis, the synchroniser moves its cut there. That is also how it
follows a camera that slides by a frame, at the price of one frame of that camera.
"""

import bisect
import statistics
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from rig_protocol.frames import PanoramicFrame, RgbdFrame

# Frames that may wait for one camera: a deadline of 200 ms at 30 Hz, and 8 × 0.9 MB of memory.
MAX_PENDING = 8
# Intervals whose median is a camera's period: odd, and long enough to outvote a few lost frames.
_INTERVALS = 9
# Gain, in periods, below which the cut stays: above the jitter of software time stamps.
_HYSTERESIS = 0.05
# A frame stamped further ahead of the rig clock than this comes from a broken clock.
_MAX_AHEAD_NS = 1_000_000_000


@dataclass(slots=True)
class SynchroniserCounters:
    """What became of frames and sets.

    `late`: their set had gone; `skipped`: left out when the cut moved or a queue was full;
    `implausible`: stamped in the future, or at the same instant as another frame of the camera.
    """

    complete: int = 0
    partial: int = 0
    late: int = 0
    skipped: int = 0
    implausible: int = 0


@dataclass(frozen=True, slots=True)
class _Pending:
    frame: RgbdFrame
    arrival_ns: int

    @property
    def timestamp_ns(self) -> int:
        return self.frame.timestamp_ns


@dataclass(slots=True)
class _Queue:
    """What waits for one camera, in the order of exposure, and the camera's measured rate."""

    period_ns: int
    live: bool = False
    late: int = 0
    pending: list[_Pending] = field(default_factory=list)
    closed_ns: int = -(2**63)  # no set takes a frame of this camera from here or before
    newest_ns: int | None = None
    intervals_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_INTERVALS))

    def insert(self, item: _Pending) -> None:
        bisect.insort(self.pending, item, key=lambda pending: pending.timestamp_ns)
        if self.newest_ns is None:
            self.newest_ns = item.timestamp_ns
        elif item.timestamp_ns > self.newest_ns:
            self.intervals_ns.append(item.timestamp_ns - self.newest_ns)
            self.newest_ns = item.timestamp_ns
            self.period_ns = int(statistics.median(self.intervals_ns))

    def holds(self, timestamp_ns: int) -> bool:
        return any(pending.timestamp_ns == timestamp_ns for pending in self.pending)

    def following_ns(self) -> tuple[int, bool]:
        """Exposure of the frame after the head, and whether that frame is already here."""
        if len(self.pending) > 1:
            return self.pending[1].timestamp_ns, True
        return self.pending[0].timestamp_ns + self.period_ns, False


class Synchroniser:
    """Groups frames by nearest rig time into sets; every set names the cameras that it lacks.

    Feed `add`, then call `next_panorama` until it returns None, and again at `next_timeout_ns`.
    A set is complete as soon as every connected camera has its frame; it goes out partial one frame
    period plus `deadline_ns` after its first frame came. No frame is used twice, no set is wider than
    `max_spread_ns` (None: one frame period).
    """

    def __init__(
        self, expected: Iterable[int], deadline_ns: int, max_spread_ns: int | None = None, fps: float = 30.0
    ) -> None:
        self.counters = SynchroniserCounters()
        self._expected = frozenset(expected)
        self._deadline_ns = deadline_ns
        self._max_spread_ns = max_spread_ns
        self._fps = fps
        self._queues = {camera_id: _Queue(_period_ns(fps)) for camera_id in self._expected}
        self._index = 0
        self._cut_moved = False

    def camera_joined(self, camera_id: int, fps: float) -> None:
        """From now on sets wait for this camera, which says that it runs at `fps`."""
        queue = self._queue(camera_id)
        queue.live = True
        queue.period_ns = _period_ns(fps)
        queue.intervals_ns.clear()
        queue.newest_ns = None

    def camera_left(self, camera_id: int) -> None:
        """Sets no longer wait for this camera; an expected one is named missing."""
        self._queue(camera_id).live = False

    def late(self, camera_id: int) -> int:
        """Frames of one camera that came after their set had gone."""
        return self._queue(camera_id).late

    def add(self, frame: RgbdFrame, now_ns: int) -> None:
        """Take a frame stamped in rig time; what comes too late or is implausible is counted."""
        queue = self._queue(frame.camera_id)
        if frame.timestamp_ns > now_ns + _MAX_AHEAD_NS or queue.holds(frame.timestamp_ns):
            self.counters.implausible += 1
            return
        if frame.timestamp_ns <= queue.closed_ns:
            self.counters.late += 1
            queue.late += 1
            return
        queue.insert(_Pending(frame, now_ns))
        if len(queue.pending) > MAX_PENDING:
            self._skip([queue])

    def next_panorama(self, now_ns: int) -> PanoramicFrame | None:
        """The next set that is complete or overdue, oldest first; None when there is none."""
        while heads := self._heads():
            window = self._window(heads)
            whole = len(window) == len(heads) and all(q.pending for q in self._queues.values() if q.live)
            if not (whole or self._overdue(now_ns)):
                return None
            cut = self._better_cut(window)
            if 0 < 2 * cut < len(window):
                self._cut_moved = True
                self._skip(window[:cut])
                continue
            # A cut past most of the cameras would lose most of a set: that set goes out as it is.
            return self._take(window[: cut or len(window)])
        return None

    def next_timeout_ns(self) -> int | None:
        """When the oldest waiting frame's set is overdue."""
        arrivals = [queue.pending[0].arrival_ns for queue in self._queues.values() if queue.pending]
        return min(arrivals) + self._period_ns() + self._deadline_ns if arrivals else None

    def _queue(self, camera_id: int) -> _Queue:
        return self._queues.setdefault(camera_id, _Queue(_period_ns(self._fps)))

    def _period_ns(self) -> int:
        """The rig's common period: the median over cameras, so that one slow camera slows no other."""
        periods = [queue.period_ns for queue in self._queues.values() if queue.live or queue.pending]
        return int(statistics.median(periods)) if periods else _period_ns(self._fps)

    def _heads(self) -> list[_Queue]:
        """The queues that hold a frame, earliest head first."""
        return sorted((q for q in self._queues.values() if q.pending), key=_head_ns)

    def _window(self, heads: Sequence[_Queue]) -> list[_Queue]:
        """The heads close enough to the oldest to share a set with it."""
        width = self._period_ns() if self._max_spread_ns is None else self._max_spread_ns
        return [queue for queue in heads if _head_ns(queue) - _head_ns(heads[0]) <= width]

    def _overdue(self, now_ns: int) -> bool:
        due_ns = self.next_timeout_ns()
        crowded = any(len(queue.pending) == MAX_PENDING for queue in self._queues.values())
        return crowded or (due_ns is not None and now_ns >= due_ns)

    def _better_cut(self, window: Sequence[_Queue]) -> int:
        """How many of the earliest heads to leave out for a tighter set; 0 when this one is tight enough.

        Guesses about frames to come may move the cut once a set: a camera that runs irregularly must
        not keep the set from ever going out.
        """
        best, best_spread = 0, _head_ns(window[-1]) - _head_ns(window[0])
        threshold = best_spread - _HYSTERESIS * self._period_ns()
        latest, guessed = _head_ns(window[-1]), False
        for cut in range(1, len(window)):
            following_ns, here = window[cut - 1].following_ns()
            latest, guessed = max(latest, following_ns), guessed or not here
            spread = latest - _head_ns(window[cut])
            if spread < min(best_spread, threshold) and not (guessed and self._cut_moved):
                best, best_spread = cut, spread
        return best

    def _skip(self, queues: Iterable[_Queue]) -> None:
        for queue in queues:
            queue.closed_ns = queue.pending.pop(0).timestamp_ns
            self.counters.skipped += 1

    def _take(self, queues: Sequence[_Queue]) -> PanoramicFrame:
        taken = {queue.pending[0].frame.camera_id: queue.pending.pop(0).frame for queue in queues}
        times = [frame.timestamp_ns for frame in taken.values()]
        cameras = self._expected | taken.keys() | {i for i, queue in self._queues.items() if queue.live}
        for camera_id in cameras:
            frame = taken.get(camera_id)
            self._queue(camera_id).closed_ns = max(times) if frame is None else frame.timestamp_ns
        panorama = PanoramicFrame(
            index=self._index,
            timestamp_ns=min(times) + sum(time - min(times) for time in times) // len(times),
            frames={camera_id: taken.get(camera_id) for camera_id in sorted(cameras)},
            spread_ns=max(times) - min(times),
        )
        self._index += 1
        self._cut_moved = False
        if panorama.complete:
            self.counters.complete += 1
        else:
            self.counters.partial += 1
        return panorama


def _head_ns(queue: _Queue) -> int:
    return queue.pending[0].timestamp_ns


def _period_ns(fps: float) -> int:
    """Frame period; a rate that makes no sense counts as 30 Hz."""
    return round(1e9 / fps) if 0.01 < fps < 1000 else 33_333_333
