"""The sets of a rig that runs on, handed over one by one, as a capture takes those of a rig of its own."""

import threading
from collections import deque
from collections.abc import Collection, Mapping

from rig_protocol.events import ControlAnswered
from rig_protocol.frames import PanoramicFrame
from rig_protocol.messages import ControlValue, Hello
from rig_protocol.rig_folder import RigDescription
from rig_server.rig import Rig

_WAITING = 4  # a set holds 11 MB; a capture takes each at once, unless it is switching projectors


class OfferedSets:
    """What a capture asks of a rig, where another thread takes the sets and hands every one over.

    Offering never waits: the oldest set makes room, which is counted.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._changed = threading.Condition()  # guards what follows
        self._waiting: deque[PanoramicFrame] = deque()
        self._wanted = True
        self.passed_over = 0

    def offer(self, panorama: PanoramicFrame) -> None:
        """Hand over a set."""
        with self._changed:
            if not self._wanted:
                return
            if len(self._waiting) == _WAITING:
                self._waiting.popleft()
                self.passed_over += 1
            self._waiting.append(panorama)
            self._changed.notify()

    @property
    def description(self) -> RigDescription:
        """The cameras."""
        return self._rig.description

    @property
    def hellos(self) -> Mapping[int, Hello]:
        """What the agents said of themselves, by camera id."""
        return self._rig.hellos

    @property
    def ended(self) -> bool:
        """True when no set will come any more."""
        return self._rig.ended and not self._waiting

    def next_panorama(self, timeout_s: float) -> PanoramicFrame | None:
        """The next set, or None when none was handed over in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting, timeout_s)
            return self._waiting.popleft() if self._waiting else None

    def control(
        self, cameras: int | Collection[int] | None, name: str, value: ControlValue
    ) -> Mapping[int, ControlAnswered]:
        """Have cameras do something; the answers by camera id."""
        return self._rig.control(cameras, name, value)

    def end_sets(self) -> None:
        """No more are needed: the rig runs on."""
        with self._changed:
            self._wanted = False
            self._waiting.clear()
