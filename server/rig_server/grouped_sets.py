"""Sets whose depth is free of the neighbours' dots: projectors shine in turns, and the sets are merged.

Every frame of a merged set, colour and depth, is of the time in which its camera's own group projected. The
scene must stand still meanwhile, as it must for any calibration.
"""

import contextlib
import logging
import time
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Protocol

from rig_protocol.errors import RigError
from rig_protocol.events import ControlAnswered, Outcome
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.messages import ControlValue, Hello
from rig_protocol.rig_folder import RigDescription
from rig_protocol.troubleshooting import Topic
from rig_server.config import CaptureSettings
from rig_server.projector_groups import Groups, assign_groups
from rig_server.receiver import rig_time_ns

logger = logging.getLogger(__name__)

_SETTLING_NS = 300_000_000  # a projector needs some 200 ms (libfreenect)
_SWITCH_AGAIN_S = 1.0  # an agent that lost its session for a moment has switched its depth on


class SetSource(Protocol):
    """What a capture asks of a rig."""

    @property
    def description(self) -> RigDescription:
        """The cameras."""
        ...

    @property
    def ended(self) -> bool:
        """True when no set will come any more."""
        ...

    def next_panorama(self, timeout_s: float) -> PanoramicFrame | None:
        """The next set, or None when none came in time."""
        ...

    def end_sets(self) -> None:
        """No more sets are needed."""
        ...


class GroupableRig(SetSource, Protocol):
    """A rig whose cameras can be told, too."""

    @property
    def hellos(self) -> Mapping[int, Hello]:
        """What the agents said of themselves, by camera id."""
        ...

    def control(
        self, cameras: int | Collection[int] | None, name: str, value: ControlValue
    ) -> Mapping[int, ControlAnswered]:
        """Have cameras do something; the answers by camera id."""
        ...


@contextlib.contextmanager
def sets_of(rig: GroupableRig, capture: CaptureSettings) -> Iterator[SetSource]:
    """The rig's sets, in projector groups where the settings say so; all depth is on again afterwards."""
    if capture.projector_groups == 1:
        yield rig
        return
    grouped = GroupedSets(rig, capture)
    try:
        yield grouped
    finally:
        grouped.all_on()


class GroupedSets:
    """Merged sets of a live rig: as many at a time as a calibration wants, then as many again."""

    def __init__(self, rig: GroupableRig, capture: CaptureSettings) -> None:
        """ConfigurationError where the groups cannot keep neighbours apart."""
        self._rig = rig
        self._sets = capture.frames
        self._patience_s = 0.8 * capture.wait_s / capture.projector_groups  # the rest is for switching
        # A camera without depth has no projector: it takes part in the first group, as it is.
        self._with_depth = {i for i, hello in rig.hellos.items() if hello.depth_codecs}
        self._groups: Groups = assign_groups(rig.description, capture.projector_groups)
        self._on = set(self._with_depth)
        self._turns: list[_Turn] = []
        self._merged: deque[PanoramicFrame] = deque()
        self._count = 0
        self._begun_s = self._switching_s = 0.0

    @property
    def description(self) -> RigDescription:
        """The cameras."""
        return self._rig.description

    @property
    def ended(self) -> bool:
        """True when no set will come any more."""
        return self._rig.ended and not self._merged

    def next_panorama(self, timeout_s: float) -> PanoramicFrame | None:
        """The next merged set; RigError when a camera cannot switch its depth."""
        if self._merged:
            return self._merged.popleft()
        if not self._turns:
            self._begun_s, self._switching_s = time.monotonic(), 0.0
            self._next_turn()
        turn, panorama = self._turns[-1], self._rig.next_panorama(timeout_s)
        if panorama is not None and turn.take(panorama) and time.monotonic() >= turn.switch_again_s:
            self._switch(turn.group)
            turn.settle()
        if turn.full or time.monotonic() >= turn.until_s:
            if len(self._turns) < len(self._groups):
                self._next_turn()
            else:
                self._merge()
        return None

    def all_on(self) -> None:
        """All cameras project again; what cannot be reached is told, and no failure."""
        dark = self._with_depth - self._on
        if not dark:
            return
        try:
            answers = self._rig.control(dark, "depth", True)
        except RigError as error:  # its agents switch on by themselves when the server has gone
            logger.warning("depth stays off until the agents see that the server has gone: %s", error)
            return
        self._on |= dark
        for camera_id, answer in answers.items():
            if answer.outcome is not Outcome.DONE:
                logger.error("camera %d: depth may still be off: %s", camera_id, answer.text)

    def end_sets(self) -> None:
        """No more sets are needed."""
        self.all_on()
        self._rig.end_sets()

    def _next_turn(self) -> None:
        group = self._groups[len(self._turns)]
        self._switch(group)
        self._turns.append(_Turn(group, self._with_depth, self._sets, self._patience_s))

    def _switch(self, group: Sequence[int]) -> None:
        """Only this group projects; the others go dark first."""
        began_s = time.monotonic()
        shining = self._with_depth.intersection(group)
        for cameras, on in ((self._with_depth - shining, False), (shining, True)):
            if not on:  # taken as dark before it is: whatever interrupts this, `all_on` sees to them
                self._on -= cameras
            answers = self._rig.control(cameras, "depth", on)
            refused = [
                f"camera {i}: {answer.text}"
                for i, answer in answers.items()
                if answer.outcome is not Outcome.DONE
            ]
            if refused:
                raise RigError(
                    "not every camera can switch its depth: " + "; ".join(refused) + ". Calibrate without "
                    "--projector-groups, or mend it",
                    Topic.CALIBRATION_REFUSED,
                )
            if on:
                self._on |= cameras
        self._switching_s += time.monotonic() - began_s + _SETTLING_NS / 1e9

    def _merge(self) -> None:
        self.all_on()
        for k in range(max(len(turn.frames) for turn in self._turns)):
            frames = {i: frame for turn in self._turns for i, frame in turn.frame(k).items()}
            if any(frame is not None for frame in frames.values()):
                self._merged.append(PanoramicFrame.of(self._count, frames))
                self._count += 1
        logger.info(
            "%d sets in %d projector groups took %.1f s, %.1f s of it for switching",
            len(self._merged),
            len(self._groups),
            time.monotonic() - self._begun_s,
            self._switching_s,
        )
        self._turns.clear()


class _Turn:
    """The time in which one group projects: collects its frames."""

    def __init__(self, group: Sequence[int], with_depth: set[int], sets: int, patience_s: float) -> None:
        self.group = group
        self._with_depth, self._sets = with_depth, sets
        self._complete: list[Mapping[int, RgbdFrame | None]] = []
        self._partial: list[Mapping[int, RgbdFrame | None]] = []
        self.until_s = time.monotonic() + patience_s
        self.settle()

    def settle(self) -> None:
        """The projectors have just been switched."""
        self._since_ns = rig_time_ns() + _SETTLING_NS
        self.switch_again_s = time.monotonic() + _SWITCH_AGAIN_S

    @property
    def full(self) -> bool:
        """True when there are enough complete sets."""
        return len(self._complete) >= self._sets

    @property
    def frames(self) -> list[Mapping[int, RgbdFrame | None]]:
        """The group's frames by camera, set by set; incomplete sets only for want of better."""
        spare = sorted(self._partial, key=lambda frames: list(frames.values()).count(None))
        return [*self._complete, *spare][: self._sets]

    def frame(self, k: int) -> Mapping[int, RgbdFrame | None]:
        """The frames of set k; None for all where there are not so many."""
        return self.frames[k] if k < len(self.frames) else dict.fromkeys(self.group)

    def take(self, panorama: PanoramicFrame) -> bool:
        """Keep what is of use; True where a camera of another group projects."""
        late = [frame for frame in panorama.frames.values() if frame and frame.timestamp_ns >= self._since_ns]
        if any(_has_depth(frame) and frame.camera_id not in self.group for frame in late):
            return True
        good = {frame.camera_id: frame for frame in late if self._is_good(frame)}
        frames = {camera_id: good.get(camera_id) for camera_id in self.group}
        if None not in frames.values():
            self._complete.append(frames)
        elif good.keys() & frames.keys() and len(self._partial) < self._sets:
            self._partial.append(frames)
        return False

    def _is_good(self, frame: RgbdFrame) -> bool:
        return not frame.damaged and (_has_depth(frame) or frame.camera_id not in self._with_depth)


def _has_depth(frame: RgbdFrame) -> bool:
    return frame.raw is not None or frame.depth_mm is not None
