"""How fast a camera really delivers, whatever it said and whatever was lost on the way."""

from collections import deque

from rig_protocol.message_bytes import MAX_FPS, MIN_FPS

# Intervals that a period is taken from: a change of rate is followed within so many frames.
_INTERVALS = 9
# Rank of the interval that counts as a single one: three of nine that lost no frame are enough, and two
# that are too short by a fault do no harm.
_SINGLE = 2
# Longer than the single interval by this factor: a frame was lost in between; shorter: a fault.
_RATIO = 1.5
# No camera is faster or slower than a hello may say, whatever its stamps say.
_SHORTEST_NS, _LONGEST_NS = round(1e9 / MAX_FPS), round(1e9 / MIN_FPS)
# A stamp older than the newest by more than this is no late frame: the camera's clock was set back.
_SET_BACK_NS = 1_000_000_000


class FrameRate:
    """The period of one camera, measured on the exposure times of the frames that come."""

    def __init__(self, fps: float) -> None:
        self.restart(fps)

    def restart(self, fps: float) -> None:
        """Begin again with a camera that says that it runs at `fps`."""
        self.period_ns = period_of(fps)
        self._intervals_ns = deque([self.period_ns] * _INTERVALS, maxlen=_INTERVALS)
        self._newest_ns: int | None = None

    def observe(self, timestamp_ns: int) -> None:
        """Learn from a frame's exposure; one older than the newest tells nothing."""
        newest_ns = self._newest_ns
        if newest_ns is None or timestamp_ns < newest_ns - _SET_BACK_NS:
            self._newest_ns = timestamp_ns
        elif timestamp_ns > newest_ns:
            self._newest_ns = timestamp_ns
            self._intervals_ns.append(timestamp_ns - newest_ns)
            single_ns = sorted(self._intervals_ns)[_SINGLE]
            least_ns, most_ns = single_ns / _RATIO, single_ns * _RATIO
            similar = [interval for interval in self._intervals_ns if least_ns < interval < most_ns]
            period_ns = sum(similar) // len(similar)
            self.period_ns = min(max(period_ns, _SHORTEST_NS), _LONGEST_NS)


def period_of(fps: float) -> int:
    """Frame period; a rate that makes no sense counts as 30 Hz."""
    return round(1e9 / fps) if MIN_FPS <= fps <= MAX_FPS else 33_333_333
