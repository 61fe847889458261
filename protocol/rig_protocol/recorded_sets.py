"""The sets of a recording put together again: which frames went out as one panoramic frame."""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from rig_protocol.frames import EncodedFrame, RgbdFrame
from rig_protocol.messages import Hello
from rig_protocol.recording_format import Entry, RecordedSet, time_of
from rig_protocol.synchroniser import Policy, Synchroniser

# Frames of a camera that a set may still ask for: those that waited in the synchroniser (8) and in sets that
# nobody had taken (4), and as many again.
_REMEMBERED = 24
_DEADLINE_NS = 100_000_000  # in recorded time nobody waits for long


@dataclass(frozen=True, slots=True)
class EncodedSet:
    """A set whose frames are still as they came; None where it has none, or the file lacks it."""

    index: int
    time_ns: int
    frames: Mapping[int, EncodedFrame | None]


def with_frames(entries: Iterable[Entry], from_ns: int = 0) -> Iterator[EncodedSet]:
    """The sets that went out from a time on, with their frames; one that has no frame is left out."""
    came: dict[int, deque[EncodedFrame]] = {}
    for entry in entries:
        if isinstance(entry, EncodedFrame):
            came.setdefault(entry.camera_id, deque(maxlen=_REMEMBERED)).append(entry)
        elif isinstance(entry, RecordedSet) and entry.taken_ns >= from_ns:
            frames = {
                camera_id: _stamped(came.get(camera_id, ()), time_ns)
                for camera_id, time_ns in entry.timestamps_ns.items()
            }
            if any(frames.values()):
                yield EncodedSet(entry.index, entry.taken_ns, frames)


def _stamped(came: Iterable[EncodedFrame], time_ns: int | None) -> EncodedFrame | None:
    return next((frame for frame in came if frame.timestamp_ns == time_ns), None)


def synchroniser_of(
    hellos: Mapping[int, Hello],
    deadline_ns: int = _DEADLINE_NS,
    max_spread_ns: int | None = None,
    policy: Policy = "partial",
) -> Synchroniser:
    """One that groups the frames of a take without sets; `hellos`: its agents, by camera id."""
    synchroniser = Synchroniser(hellos, deadline_ns, max_spread_ns, policy=policy)
    for camera_id, hello in hellos.items():
        synchroniser.camera_joined(camera_id, hello.fps)
    return synchroniser


def with_sets(entries: Iterable[Entry], synchroniser: Synchroniser) -> Iterator[Entry]:
    """The entries of a take without sets, and the sets that the synchroniser makes, in recorded time."""
    now_ns = 0
    for entry in entries:
        yield entry
        if isinstance(entry, EncodedFrame):
            now_ns = max(now_ns, time_of(entry))
            synchroniser.add(_without_images(entry), now_ns)
            yield from _sets_due(synchroniser, now_ns)
    while synchroniser.waiting and (due_ns := synchroniser.next_timeout_ns()) is not None:
        waiting, now_ns = synchroniser.waiting, max(now_ns, due_ns)
        yield from _sets_due(synchroniser, now_ns)
        if synchroniser.waiting == waiting:
            return


def _sets_due(synchroniser: Synchroniser, now_ns: int) -> Iterator[RecordedSet]:
    while (panorama := synchroniser.next_panorama(now_ns)) is not None:
        yield RecordedSet.of(panorama, now_ns)


def _without_images(frame: EncodedFrame) -> RgbdFrame:
    return RgbdFrame(frame.camera_id, frame.sequence, frame.timestamp_ns, frame.uncertainty_ns)
