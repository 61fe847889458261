"""The queues of all cameras of a rig, and what became of their frames."""

from dataclasses import dataclass
from statistics import median_low

from rig_protocol.camera_queue import MAX_PENDING, NEVER_NS, CameraQueue
from rig_protocol.frame_rate import period_of
from rig_protocol.frames import RgbdFrame


@dataclass(slots=True)
class SynchroniserCounters:
    """What became of frames and sets.

    Sets: `complete` and `partial` went out; `incomplete` ones did not, under the policy strict.
    Frames: `late`: their set had gone; `skipped`: left out when the cut moved, a queue was full, a newer
    one replaced it or its set was incomplete; `implausible`: stamped in the future, or at the same instant
    as another frame of the camera. `repeated`: frames that went out once more, under the policy latest.
    """

    complete: int = 0
    partial: int = 0
    incomplete: int = 0
    late: int = 0
    skipped: int = 0
    implausible: int = 0
    repeated: int = 0


class RigQueues:
    """One queue a camera; cameras that are unknown get one when they are first asked for."""

    def __init__(self, fps: float) -> None:
        self.counters = SynchroniserCounters()
        self.by_id: dict[int, CameraQueue] = {}
        self.oldest_arrival_ns: int | None = None
        self._fps = fps
        self._closed_ns = NEVER_NS

    def __getitem__(self, camera_id: int) -> CameraQueue:
        queue = self.by_id.get(camera_id)
        if queue is None:
            queue = self.by_id[camera_id] = CameraQueue(camera_id, self._fps, self._closed_ns)
        return queue

    @property
    def holding(self) -> list[CameraQueue]:
        """The queues with a frame."""
        return [queue for queue in self.by_id.values() if queue.pending]

    def overdue(self, now_ns: int, longest_wait_ns: int) -> bool:
        """True when a frame has waited for so long."""
        return self.oldest_arrival_ns is not None and now_ns >= self.oldest_arrival_ns + longest_wait_ns

    def crowded(self, period_ns: int) -> bool:
        """True when a camera's frames of several periods fill its queue."""
        return any(queue.crowded(period_ns) for queue in self.by_id.values())

    def insert(self, frame: RgbdFrame, now_ns: int) -> None:
        """Let a frame wait; when there is no room, the camera's oldest one is skipped."""
        queue = self[frame.camera_id]
        queue.insert(frame, now_ns)
        if self.oldest_arrival_ns is None:
            self.oldest_arrival_ns = now_ns
        if len(queue.pending) > MAX_PENDING:
            self.skip([queue])

    def is_ahead_of(self, now_ns: int) -> bool:
        """True when what is known is of a time to come: the rig clock was set back."""
        arrived_later = self.oldest_arrival_ns is not None and self.oldest_arrival_ns > now_ns
        return arrived_later or self._closed_ns > now_ns

    def begin_anew(self) -> None:
        """Forget all frames and times; the cameras stay, with their rates."""
        known, self.by_id = self.by_id, {}
        self.counters.skipped += sum(len(queue.pending) for queue in known.values())
        self._closed_ns, self.oldest_arrival_ns = NEVER_NS, None
        for camera_id, queue in known.items():
            fresh = self[camera_id]
            fresh.late = queue.late
            if queue.live:
                fresh.join(1e9 / queue.rate.period_ns)

    def skip(self, queues: list[CameraQueue]) -> None:
        """Leave the first frame of each of these out of every set."""
        for queue in queues:
            queue.pop()
        self.counters.skipped += len(queues)
        self.update_oldest()

    def count_late(self, camera_id: int) -> None:
        """A frame came after its set had gone."""
        self.counters.late += 1
        self[camera_id].late += 1

    def close(self, time_ns: int) -> None:
        """No set takes a frame from then or before, so that sets go out in the order of time."""
        self._closed_ns = time_ns
        for queue in self.by_id.values():
            queue.closed_ns = max(queue.closed_ns, time_ns)
            while queue.pending and queue.pending[0].timestamp_ns <= time_ns:
                self.skip([queue])

    def update_oldest(self) -> None:
        """Call after frames were taken."""
        arrivals_ns = [item.arrival_ns for queue in self.by_id.values() for item in queue.pending]
        self.oldest_arrival_ns = min(arrivals_ns, default=None)

    def common_period_ns(self) -> int:
        """The period of most cameras: at least half of them run at it or faster."""
        return median_low(self._periods_ns())

    def longest_period_ns(self) -> int:
        """The period of the slowest camera."""
        return max(self._periods_ns())

    def _periods_ns(self) -> list[int]:
        periods = [queue.rate.period_ns for queue in self.by_id.values() if queue.live or queue.pending]
        return periods or [period_of(self._fps)]
