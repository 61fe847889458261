"""Sets that wait for nobody longer than a period: the policy latest."""

from collections.abc import Mapping, Sequence

from rig_protocol.camera_queue import CameraQueue
from rig_protocol.frames import RgbdFrame, mean_time_ns
from rig_protocol.rig_queues import RigQueues

# A frame counts for so many periods of its camera: the next one is then half a period late.
_COUNTS_PERIODS = 1.5


class LatestPolicy:
    """Chooses the newest frame of each camera as soon as each has a new one, or one period after the first.

    A connected camera without a new frame gives the one that went out last once more. No frame of a set is
    older, against the newest, than 1.5 periods of its camera (nor than `max_spread_ns`). A frame waits one
    period, that of most cameras, at most; those that a newer one replaces meanwhile are skipped.
    """

    def __init__(self, queues: RigQueues, max_spread_ns: int | None) -> None:
        self._queues = queues
        self._max_spread_ns = max_spread_ns
        self._last_set_ns: int | None = None
        self.blocker: CameraQueue | None = None
        self.period_ns = queues.common_period_ns()

    @property
    def longest_wait_ns(self) -> int:
        """How long a frame waits at most."""
        return self.period_ns

    def settle(self) -> None:
        """Nothing is kept from set to set that other cameras would change."""

    def choose(self, now_ns: int) -> dict[int, RgbdFrame] | None:
        """Take the next set's frames; None when there is none: it waits for `blocker`, or nothing is here."""
        self.blocker = None
        self.period_ns = self._queues.common_period_ns()
        while holding := self._queues.holding:
            awaited = self._awaited(holding)
            if awaited and not self._queues.overdue(now_ns, self.longest_wait_ns):
                self.blocker = awaited[-1]
                return None
            for queue in awaited:
                queue.miss(queue.closed_ns, waited=True)
            if taken := self._take():
                return taken
        return None

    def _awaited(self, holding: Sequence[CameraQueue]) -> list[CameraQueue]:
        """Cameras without a new frame that should send one within the period."""
        first_ns = min(queue.pending[0].timestamp_ns for queue in holding)
        from_ns, to_ns = first_ns - self.period_ns // 2, first_ns + self.period_ns
        return [
            queue
            for queue in self._queues.by_id.values()
            if queue.awaited and not queue.pending and (queue.expected_after(from_ns) or to_ns) <= to_ns
        ]

    def _take(self) -> dict[int, RgbdFrame]:
        """The frames of the set, none where nothing of it would be new."""
        found, fresh = self._newest()
        taken = self._in_order(self._young(found))
        for camera_id in fresh - taken.keys():
            self._queues.count_late(camera_id)
        if fresh.isdisjoint(taken):
            return {}
        self._queues.counters.repeated += len(taken.keys() - fresh)
        for camera_id, queue in self._queues.by_id.items():
            queue.shown = taken.get(camera_id) if queue.live else None
        self._last_set_ns = mean_time_ns(taken.values())
        return taken

    def _newest(self) -> tuple[dict[int, RgbdFrame], set[int]]:
        """The newest frame of every camera that has one, and the cameras whose frame is a new one."""
        found, fresh = {}, set()
        for camera_id, queue in self._queues.by_id.items():
            if queue.pending:
                self._queues.skip([queue] * (len(queue.pending) - 1))
                found[camera_id] = queue.pop()
                fresh.add(camera_id)
            elif queue.shown is not None:
                found[camera_id] = queue.shown
        self._queues.update_oldest()
        return found, fresh

    def _young(self, found: Mapping[int, RgbdFrame]) -> dict[int, RgbdFrame]:
        """Those that count for the camera whose frame is the newest."""
        newest_ns = max(frame.timestamp_ns for frame in found.values())
        return {
            camera_id: frame
            for camera_id, frame in found.items()
            if newest_ns - frame.timestamp_ns <= self._oldest_age_ns(camera_id)
        }

    def _in_order(self, young: dict[int, RgbdFrame]) -> dict[int, RgbdFrame]:
        """Without the frames that would put this set before the last one: a camera with old frames joined."""
        last_ns = self._last_set_ns
        if last_ns is None or mean_time_ns(young.values()) > last_ns:
            return young
        return {camera_id: frame for camera_id, frame in young.items() if frame.timestamp_ns > last_ns}

    def _oldest_age_ns(self, camera_id: int) -> float:
        age_ns = _COUNTS_PERIODS * self._queues[camera_id].rate.period_ns
        return age_ns if self._max_spread_ns is None else min(age_ns, self._max_spread_ns)
