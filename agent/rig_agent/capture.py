"""The thread that keeps a source open, through every loss of the device, and hands on its frames."""

import logging
import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from rig_agent.sources.base import ControlRefused, ControlValue, FrameSource, SourceDescription, SourceLost
from rig_agent.transport import now_ns
from rig_protocol.errors import RigError
from rig_protocol.frames import RgbdFrame
from rig_protocol.gravity import Gravity
from rig_protocol.troubleshooting import see

_log = logging.getLogger(__name__)

_READ_TIMEOUT_S = 0.5
_FIRST_RETRY_S = 0.5
_LAST_RETRY_S = 2.0  # a Kinect plugged in again must be back within 5 s
_MAX_CONTROLS = 32  # the server has one under way; more are of sessions that have ended

REOPEN = "reopen_source"
"""The control that closes any source and opens it again."""
Told = Callable[[bool, str], None]
"""What became of a control: done or refused, and in words."""


@dataclass(slots=True)
class CaptureCounters:
    """What the source delivered and how often it was lost."""

    captured: int = 0
    damaged: int = 0
    losses: int = 0


class Capture:
    """Runs one source after another: open, read until it is lost, wait, open again.

    `on_open`, `on_frame` and `on_left_out` are called on the capture thread and must not wait. `on_failure`
    gets what no new attempt can cure (a torn file, a wrong setting); the thread has then ended.
    """

    def __init__(
        self,
        open_source: Callable[[], FrameSource],
        max_fps: float | None,
        on_open: Callable[[SourceDescription], None],
        on_frame: Callable[[RgbdFrame], None],
        on_failure: Callable[[Exception], None],
        on_left_out: Callable[[RgbdFrame], None] = lambda _: None,
    ) -> None:
        """Frames beyond `max_fps` are left out evenly; its count is that of the next one that is not."""
        self._open_source = open_source
        self._max_fps = max_fps
        self._wanted: tuple[float | None, int] = None, 0
        self._on_open, self._on_frame, self._on_failure = on_open, on_frame, on_failure
        self._on_left_out = on_left_out
        self._controls: deque[tuple[str, ControlValue, Told]] = deque(maxlen=_MAX_CONTROLS)
        self._stopping = threading.Event()
        # A daemon: a driver that hangs must not keep the program from ending.
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)
        self._next_sequence = 0
        self.last_sign_ns = now_ns()
        self.gravity: Gravity | None = None  # as the source felt it with its latest frame
        self.counters = CaptureCounters()
        self.source_counters: Mapping[
            str, int
        ] = {}  # the drivers' own, of all openings; replaced, not changed

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def want(self, max_fps: float | None, rig_offset_ns: int) -> None:
        """What the server wants, from any thread; rig time is agent time and `rig_offset_ns`."""
        self._wanted = max_fps, rig_offset_ns

    def control(self, name: str, value: ControlValue, told: Told) -> None:
        """Set something of the source, before it is read again; any thread may ask, capture's `told`."""
        self._controls.append((name, value, told))

    def stop(self, timeout_s: float) -> bool:
        """Close the source; False when the driver did not come back in time."""
        self._stopping.set()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        retry_s, told = _FIRST_RETRY_S, ""
        while not self._stopping.is_set():
            captured = self.counters.captured
            try:
                self._run_source()
            except SourceLost as error:
                self.gravity = None
                self.counters.losses += 1
                if self.counters.captured > captured:
                    retry_s, told = _FIRST_RETRY_S, ""
                if str(error) != told:
                    _log.warning("%s; trying again until it is back", error, extra=see(error.topic))
                told = str(error)
                self._refuse_controls(f"there is no camera: {error}")
                self._stopping.wait(retry_s)
                retry_s = min(2 * retry_s, _LAST_RETRY_S)
            except Exception as error:  # the thread's boundary: whatever it is, the owner must hear of it
                self._on_failure(error)
                return

    def _run_source(self) -> None:
        self.last_sign_ns = now_ns()
        with self._open_source() as source:
            description = source.describe()
            self._on_open(description)
            wanted = _Thinning()
            offset: int | None = None
            counted_before = Counter(self.source_counters)
            while not self._stopping.is_set():
                if not self._obey(source):
                    return
                frame = source.read(_READ_TIMEOUT_S)
                self.last_sign_ns = now_ns()
                self.source_counters = counted_before + Counter(source.counters)
                if frame is None:
                    continue
                self.gravity = frame.gravity
                # A source that was opened again, or whose clock was set back, counts on where it was.
                if offset is None or frame.sequence + offset < self._next_sequence:
                    offset = self._next_sequence - frame.sequence
                counted = replace(frame, sequence=frame.sequence + offset)
                if self._is_wanted(wanted, frame.timestamp_ns, description.fps):
                    self._deliver(counted)
                else:  # left out on purpose: no gap in the count, which tells of frames that were lost
                    self._on_left_out(counted)
                    offset -= 1

    def _obey(self, source: FrameSource) -> bool:
        """Do what was asked for meanwhile; False when the source is to be opened again."""
        while self._controls:
            name, value, told = self._controls.popleft()
            if name == REOPEN:
                told(True, "the source is closed and opened again")
                return False
            try:
                told(True, source.control(name, value))
                self._on_open(source.describe())  # colour may come in another format from now on
            except SourceLost as error:
                told(False, str(error))
                raise
            except ControlRefused as error:
                told(False, f"{error}; of every agent: log_level, {REOPEN}, restart_agent")
            except RigError as error:
                told(False, str(error))
        return True

    def _refuse_controls(self, why: str) -> None:
        while self._controls:
            self._controls.popleft()[2](False, why)

    def _is_wanted(self, thinning: "_Thinning", timestamp_ns: int, source_fps: float) -> bool:
        wanted_fps, rig_offset_ns = self._wanted
        max_fps = min(self._max_fps or source_fps, wanted_fps or source_fps)
        return max_fps >= source_fps or thinning.accepts(timestamp_ns + rig_offset_ns, max_fps, source_fps)

    def _deliver(self, frame: RgbdFrame) -> None:
        self._next_sequence = frame.sequence + 1
        self.counters.captured += 1
        self.counters.damaged += frame.damaged
        self._on_frame(frame)


class _Thinning:
    """Lets frames of a source pass at a lower rate, the same moments of rig time at all agents.

    The first one is exposed in the first part of an interval of rig time that is one source period long; the
    others follow evenly, each the nearest to its due time.
    """

    def __init__(self) -> None:
        self._fps = 0.0
        self._due_ns = 0.0

    def accepts(self, rig_time_ns: int, max_fps: float, source_fps: float) -> bool:
        """True for a frame that is due at a rate of `max_fps`, below `source_fps`."""
        interval_ns, source_ns = 1e9 / max_fps, 1e9 / source_fps
        if max_fps != self._fps or abs(rig_time_ns - self._due_ns) > interval_ns:
            # A quarter of a period on: frames at whole intervals must not depend on a microsecond.
            if (rig_time_ns + source_ns / 4) % interval_ns >= source_ns:
                return False
            self._fps, self._due_ns = max_fps, rig_time_ns
        if rig_time_ns < self._due_ns - source_ns / 2:
            return False
        self._due_ns += interval_ns
        return True
