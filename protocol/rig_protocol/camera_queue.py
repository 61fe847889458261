"""What waits for one camera, and when its next frame is expected."""

from bisect import insort
from typing import NamedTuple

from rig_protocol.frame_rate import FrameRate
from rig_protocol.frames import RgbdFrame

# Frames that may wait for one camera: a deadline of 200 ms at 30 Hz, and 8 × 0.9 MB of memory.
MAX_PENDING = 8
# Periods that the frames of a full queue span at least when it is the sets that are late.
_CROWDED_PERIODS = 3
# Sets in a row that wait in vain for a camera; then none does until it delivers again. A second at 30 Hz.
_PATIENCE = 30
# No exposure time lies before this.
NEVER_NS = -(2**63)


class Pending(NamedTuple):
    """A frame that waits, and since when."""

    frame: RgbdFrame
    arrival_ns: int

    @property
    def timestamp_ns(self) -> int:
        """Exposure in rig time."""
        return self.frame.timestamp_ns


class Head(NamedTuple):
    """The next exposure of a camera that a set may take, its frame here or not, and the one after it."""

    exposure_ns: int
    here: bool
    following_ns: int
    queue: "CameraQueue"


class CameraQueue:
    """The frames of one camera in order of exposure; `closed_ns`: no set takes a frame from then or before.

    `live`: the camera is connected. `awaited`: its frames are worth waiting for.
    """

    def __init__(self, camera_id: int, fps: float, closed_ns: int = NEVER_NS) -> None:
        self.camera_id = camera_id
        self.rate = FrameRate(fps)
        self.live = False
        self.late = 0
        self.pending: list[Pending] = []
        self.closed_ns = closed_ns
        self.shown: RgbdFrame | None = None  # the frame that went out last, where the policy may repeat it
        self._expected_ns: int | None = None  # the next exposure that no set has had
        self._waited_in_vain = 0

    @property
    def awaited(self) -> bool:
        """False for a camera that is not connected, or that has not delivered in time for a second."""
        return self.live and self._waited_in_vain < _PATIENCE

    def crowded(self, period_ns: int) -> bool:
        """True when no room is left and sets must go; a fast camera whose surplus frames fill it waits on."""
        if len(self.pending) < MAX_PENDING:
            return False
        return self.pending[-1].timestamp_ns - self.pending[0].timestamp_ns >= _CROWDED_PERIODS * period_ns

    def join(self, fps: float) -> None:
        """The camera is connected, at a phase that nobody knows yet."""
        self.live = True
        self.rate.restart(fps)
        self._expected_ns = None
        self._waited_in_vain = 0

    def leave(self) -> None:
        """The camera is gone; what it sent still counts."""
        self.live = False
        self.shown = None

    def holds(self, timestamp_ns: int) -> bool:
        """Whether a frame of this exposure waits."""
        return any(item.frame.timestamp_ns == timestamp_ns for item in self.pending)

    def insert(self, frame: RgbdFrame, now_ns: int) -> None:
        """Let a frame wait."""
        item = Pending(frame, now_ns)
        if self.pending and frame.timestamp_ns < self.pending[-1].frame.timestamp_ns:
            insort(self.pending, item, key=_exposure_ns)
        else:
            self.pending.append(item)
        self._waited_in_vain = 0

    def expected_after(self, time_ns: int) -> int | None:
        """The next exposure expected, not before `time_ns`; None where no frame has told the phase."""
        if self._expected_ns is not None and self._expected_ns < time_ns:
            period_ns = self.rate.period_ns
            self._expected_ns += -((self._expected_ns - time_ns) // period_ns) * period_ns
        return self._expected_ns

    def head(self, earliest_ns: int) -> Head | None:
        """The next exposure from `earliest_ns` on, here or expected; None where nothing is known of it."""
        period_ns = self.rate.period_ns
        earliest_ns = max(earliest_ns, self.closed_ns + 1)
        expected_ns = self.expected_after(earliest_ns) if self.awaited else None
        if not self.pending:
            if expected_ns is None:
                return None
            return Head(expected_ns, False, expected_ns + period_ns, self)
        first_ns = self.pending[0].frame.timestamp_ns
        if expected_ns is not None and expected_ns < first_ns - period_ns // 2:
            # Frames are missing before the first one here, which tells the phase better.
            ahead = min(round((first_ns - expected_ns) / period_ns), (first_ns - earliest_ns) // period_ns)
            if ahead > 0:
                expected_ns = first_ns - ahead * period_ns
                return Head(expected_ns, False, expected_ns + period_ns, self)
        return self.real_head()

    def real_head(self) -> Head:
        """The first frame that is here; there must be one."""
        first_ns = self.pending[0].frame.timestamp_ns
        following_ns = first_ns + self.rate.period_ns
        if len(self.pending) > 1:
            following_ns = self.pending[1].frame.timestamp_ns
        return Head(first_ns, True, following_ns, self)

    def pop(self) -> RgbdFrame:
        """The first frame that waits; no older one is taken from now on."""
        frame = self.pending.pop(0).frame
        self.closed_ns = max(self.closed_ns, frame.timestamp_ns)
        self._expected_ns = frame.timestamp_ns + self.rate.period_ns
        return frame

    def pass_over(self) -> None:
        """Expect the next frame but one: the next one is not wanted any more."""
        if self._expected_ns is not None:
            self._expected_ns += self.rate.period_ns

    def miss(self, set_end_ns: int, waited: bool) -> None:
        """A set went without this camera, after waiting for it or not."""
        self.closed_ns = max(self.closed_ns, set_end_ns)
        if waited:
            self._waited_in_vain += 1
            self.pass_over()


def _exposure_ns(item: Pending) -> int:
    return item.frame.timestamp_ns
