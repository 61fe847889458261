"""Sets that wait for their cameras: the policies partial and strict.

Marked on a circle one period round, the exposures of free-running cameras leave gaps; the tightest set
starts after the widest gap. The next exposure of each camera (its head: a frame that waits, or one that is
expected) is a candidate; where starting a frame later for the earliest cameras would be tighter by more
than that costs, the cut moves there. That is also how a set follows a camera that slides by a frame, at
the price of one frame of that camera, and why a slow camera is not waited for while none of its is due.
"""

from collections.abc import Sequence

from rig_protocol.camera_queue import CameraQueue, Head
from rig_protocol.frames import RgbdFrame, mean_time_ns
from rig_protocol.rig_queues import RigQueues

# A move of the cut costs frames. In the first sets after a camera joined or left it is worth this gain of
# spread, in periods (above the jitter of software time stamps), and once in so many sets later on ...
_SMALL_GAIN = 0.05
_SETTLING_SETS = 30
_SETTLED_SETS = 1500
# ... and at any time it is worth this gain.
_LARGE_GAIN = 0.2


class WaitingPolicy:
    """Chooses sets whose cameras are all here, and what is here of sets that are overdue.

    A frame waits one period and the deadline at most. Period: that of most cameras; when `strict`, that of
    the slowest, and then a set that lacks a camera is no alternative to a later one.
    """

    def __init__(
        self, queues: RigQueues, deadline_ns: int, max_spread_ns: int | None, *, strict: bool
    ) -> None:
        self._queues = queues
        self._deadline_ns = deadline_ns
        self._max_spread_ns = max_spread_ns
        self._strict = strict
        self._settling = _SETTLING_SETS
        self._since_move = 0
        self.blocker: CameraQueue | None = None
        self._measure()

    @property
    def longest_wait_ns(self) -> int:
        """How long a frame waits at most."""
        return self.period_ns + self._deadline_ns

    def settle(self) -> None:
        """The cameras are not the same any more: look for the best cut anew."""
        self._settling = _SETTLING_SETS

    def choose(self, now_ns: int) -> dict[int, RgbdFrame] | None:
        """Take the next set's frames; None when there is none: it waits for `blocker`, or nothing is here."""
        self._measure()
        while holding := self._queues.holding:
            heads, unknown = self._heads(holding)
            chosen = self._cut(heads)
            if chosen is None:
                continue
            awaited = unknown + [head.queue for head in chosen if not head.here]
            overdue = self._queues.overdue(now_ns, self.longest_wait_ns)
            if awaited and not (overdue or self._queues.crowded(self.period_ns)):
                self.blocker = awaited[0] if unknown else awaited[-1]
                return None
            if self._strict and not (overdue or unknown or self._complete(chosen) or self._late(chosen)):
                self._queues.skip([next(head.queue for head in chosen if head.here)])
                continue
            return self._take(chosen, awaited)
        self.blocker = None
        return None

    def _measure(self) -> None:
        self._common_period_ns = self._queues.common_period_ns()
        self.period_ns = self._queues.longest_period_ns() if self._strict else self._common_period_ns
        self._width_ns = self.period_ns if self._max_spread_ns is None else self._max_spread_ns

    def _heads(self, holding: Sequence[CameraQueue]) -> tuple[list[Head], list[CameraQueue]]:
        """Heads that may share a set, earliest first, and awaited cameras of which nothing is known yet."""
        earliest_ns = min(queue.pending[0].timestamp_ns for queue in holding) - self._width_ns
        heads, unknown = [], []
        for queue in self._queues.by_id.values():
            head = queue.head(earliest_ns)
            if head is not None:
                heads.append(head)
            elif queue.awaited:
                unknown.append(queue)
        heads.sort(key=_exposure_ns)
        last_ns = heads[0].exposure_ns + self._width_ns
        return [head for head in heads if head.exposure_ns <= last_ns], unknown

    def _cut(self, window: Sequence[Head]) -> Sequence[Head] | None:
        """The heads that make the next set; None when some of the earliest were left out: look again."""
        free = self._settling > 0 or self._since_move >= _SETTLED_SETS
        cut = self._better_cut(window, (_SMALL_GAIN if free else _LARGE_GAIN) * self._common_period_ns)
        early = window[:cut] or window
        if not any(head.here for head in early):
            for head in early:
                head.queue.pass_over()
            return None
        if cut == 0:
            return window
        if 2 * cut >= len(window) and not self._strict:
            # Leaving these out would lose most of a set: they go out without the others.
            if all(head.here for head in early):
                self._note_move(window[cut:])
            return early
        if not all(head.here for head in window):
            return window
        self._note_move(early)
        self._queues.skip([head.queue for head in early])
        return None

    def _note_move(self, without: Sequence[Head]) -> None:
        """A camera of the common rate lost its place in a set; slower and faster ones do all the time."""
        ratios = (head.queue.rate.period_ns / self._common_period_ns for head in without)
        if any(2 / 3 < ratio < 3 / 2 for ratio in ratios):
            self._since_move = 0

    def _better_cut(self, window: Sequence[Head], hysteresis_ns: float) -> int:
        """How many of the earliest heads to leave out for a tighter set; 0 when this one is tight enough."""
        last_ns = window[-1].exposure_ns
        best, best_spread_ns = 0, last_ns - window[0].exposure_ns - hysteresis_ns
        for cut in range(1, len(window)):
            last_ns = max(last_ns, window[cut - 1].following_ns)
            spread_ns = last_ns - window[cut].exposure_ns
            if spread_ns < best_spread_ns:
                best, best_spread_ns = cut, spread_ns
        return best

    def _complete(self, chosen: Sequence[Head]) -> bool:
        """True when the set holds a frame of every camera that can be waited for."""
        here = {head.queue for head in chosen if head.here}
        return all(queue in here or not queue.awaited for queue in self._queues.by_id.values())

    def _late(self, chosen: Sequence[Head]) -> bool:
        """True when a camera's frame should be here; False where the camera is slower and others' surplus."""
        late_ns = max(queue.pending[-1].timestamp_ns for queue in self._queues.holding)
        late_ns -= self._common_period_ns
        return any(not head.here and head.exposure_ns < late_ns for head in chosen)

    def _take(self, chosen: Sequence[Head], awaited: Sequence[CameraQueue]) -> dict[int, RgbdFrame]:
        taken = {head.queue.camera_id: head.queue.pop() for head in chosen if head.here}
        end_ns = max(frame.timestamp_ns for frame in taken.values())
        for camera_id, queue in self._queues.by_id.items():
            if camera_id not in taken:
                queue.miss(end_ns, waited=queue in awaited)
        self._queues.update_oldest()
        self._queues.close(mean_time_ns(taken.values()))
        self._settling = max(self._settling - 1, 0)
        self._since_move += 1
        return taken


def _exposure_ns(head: Head) -> int:
    return head.exposure_ns
