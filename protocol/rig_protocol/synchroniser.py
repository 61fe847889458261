"""The synchroniser: frames of free-running cameras in, panoramic frames out. Pure: time is an argument.

Twelve Kinects run at one rate with phases of their own and no trigger; a camera may run slower than the
others, drift, lose frames, stop and come back. The policy says for whom a set waits.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from rig_protocol.camera_queue import CameraQueue
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.latest_policy import LatestPolicy
from rig_protocol.rig_queues import RigQueues, SynchroniserCounters
from rig_protocol.waiting_policy import WaitingPolicy

Policy = Literal["partial", "strict", "latest"]
"""Which sets go out, and when."""

# A frame stamped further ahead of the rig clock than this comes from a broken clock.
_MAX_AHEAD_NS = 50_000_000
# Incomplete sets that are remembered for the operator: two seconds at 30 Hz.
_REMEMBERED = 60


@dataclass(frozen=True, slots=True)
class IncompleteSet:
    """A set that did not go out under the policy strict, and whom it lacked."""

    decided_ns: int
    missing: tuple[int, ...]


class Synchroniser:
    """Groups frames by nearest rig time into sets, in the order of time; every set names whom it lacks.

    Feed `add`, then call `next_panorama` until it returns None, and again at `next_timeout_ns`.
    With T the period of most cameras and D the deadline:

    - partial: a set goes out as soon as every camera of which a frame is due has its frame, else T + D
      after its first frame came. A slower camera is missing from the sets between its frames.
    - strict: only complete sets, as soon as they are; T is the period of the slowest camera and the others'
      surplus frames are skipped. A set that lacks a camera T + D after its first frame came is dropped.
    - latest: the newest frame of every camera as soon as each has a new one, else T after the first of them
      came. A camera without a new one gives its last once more while that is younger than 1.5 of its periods.

    Under partial and strict no frame is used twice and no frame waits longer than T + D; under latest none
    longer than T. At most MAX_PENDING frames of a camera wait, whatever the deadline. No set is wider
    than `max_spread_ns` (None: T; under latest 1.5 periods of the slowest camera).
    """

    def __init__(
        self,
        expected: Iterable[int],
        deadline_ns: int,
        max_spread_ns: int | None = None,
        fps: float = 30.0,
        policy: Policy = "partial",
    ) -> None:
        self.incomplete: deque[IncompleteSet] = deque(maxlen=_REMEMBERED)
        self._expected = frozenset(expected)
        self._strict = policy == "strict"
        self._queues = RigQueues(fps)
        self._latest = policy == "latest"
        self._deadline_ns, self._max_spread_ns = deadline_ns, max_spread_ns
        self._policy = self._make_policy()
        self._index = 0
        self._stirred = False  # something came that may make a set

    @property
    def counters(self) -> SynchroniserCounters:
        """What became of frames and sets."""
        return self._queues.counters

    @property
    def longest_wait_ns(self) -> int:
        """How long a frame that comes now waits for its set at most."""
        return self._policy.longest_wait_ns

    @property
    def waiting(self) -> int:
        """Frames that wait for their set."""
        return sum(len(queue.pending) for queue in list(self._queues.by_id.values()))

    def camera_joined(self, camera_id: int, fps: float) -> None:
        """From now on sets wait for this camera, which says that it runs at `fps`."""
        self._queues[camera_id].join(fps)
        self._policy.settle()
        self._stirred = True

    def camera_left(self, camera_id: int) -> None:
        """Sets no longer wait for this camera; an expected one is named missing."""
        self._queues[camera_id].leave()
        self._policy.settle()
        self._stirred = True

    def late(self, camera_id: int) -> int:
        """Frames of one camera that came after their set had gone."""
        queue = self._queues.by_id.get(camera_id)
        return 0 if queue is None else queue.late

    def add(self, frame: RgbdFrame, now_ns: int) -> None:
        """Take a frame stamped in rig time; what comes too late or is implausible is counted."""
        queue = self._queues[frame.camera_id]
        if self._queues.is_ahead_of(now_ns + _MAX_AHEAD_NS) or queue.closed_ns > now_ns + _MAX_AHEAD_NS:
            self._queues.begin_anew()
            self._policy = self._make_policy()
            queue = self._queues[frame.camera_id]
        if frame.timestamp_ns > now_ns + _MAX_AHEAD_NS or queue.holds(frame.timestamp_ns):
            self.counters.implausible += 1
            return
        # Late frames tell the rate too: a camera that became faster would else stay late for ever.
        queue.rate.observe(frame.timestamp_ns)
        if frame.timestamp_ns <= queue.closed_ns:
            self._queues.count_late(frame.camera_id)
            return
        self._queues.insert(frame, now_ns)
        self._stirred |= self._may_complete(queue)

    def next_panorama(self, now_ns: int) -> PanoramicFrame | None:
        """The next set that may go out, oldest first; None when there is none."""
        due_ns = self.next_timeout_ns()
        if not self._stirred and (due_ns is None or now_ns < due_ns):
            return None
        self._stirred = True  # behind an overdue set there may be others
        while (taken := self._policy.choose(now_ns)) is not None:
            panorama = self._panorama(taken)
            if panorama.complete:
                self.counters.complete += 1
            elif self._strict:
                self._drop(panorama, now_ns)
                continue
            else:
                self.counters.partial += 1
            self._index += 1
            return panorama
        self._stirred = False
        return None

    def next_timeout_ns(self) -> int | None:
        """When a frame that waits has waited long enough; None when none waits."""
        oldest_ns = self._queues.oldest_arrival_ns
        return None if oldest_ns is None else oldest_ns + self._policy.longest_wait_ns

    def _make_policy(self) -> LatestPolicy | WaitingPolicy:
        if self._latest:
            return LatestPolicy(self._queues, self._max_spread_ns)
        return WaitingPolicy(self._queues, self._deadline_ns, self._max_spread_ns, strict=self._strict)

    def _may_complete(self, queue: CameraQueue) -> bool:
        """Whether this camera's frame is worth a look: the next set waits for it, or its queue is full."""
        blocker = self._policy.blocker
        return blocker is None or blocker is queue or queue.crowded(self._policy.period_ns)

    def _panorama(self, taken: dict[int, RgbdFrame]) -> PanoramicFrame:
        live = {camera_id for camera_id, queue in self._queues.by_id.items() if queue.live}
        cameras = sorted(self._expected | taken.keys() | live)
        return PanoramicFrame.of(self._index, {camera_id: taken.get(camera_id) for camera_id in cameras})

    def _drop(self, panorama: PanoramicFrame, now_ns: int) -> None:
        self.counters.incomplete += 1
        self.counters.skipped += len(panorama.frames) - len(panorama.missing)
        self.incomplete.append(IncompleteSet(now_ns, panorama.missing))
