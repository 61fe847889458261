"""Takes of several machines as one: entries in the order of time, on one clock, grouped into sets.

Every take is read twice, never held: first its clocks and what its cameras cover, then its frames.
"""

import heapq
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC as UTC_ZONE
from datetime import datetime
from itertools import combinations
from pathlib import Path
from typing import Any

from rig_calib.stages import Progress
from rig_calib.take_clock import LATEST_NS, ClockMap, clock_maps, common_clock
from rig_calib.whole_file import whole_file
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import EncodedFrame
from rig_protocol.message_fields import integer
from rig_protocol.messages import Hello
from rig_protocol.recorded_hellos import recorded_hellos, told_hellos
from rig_protocol.recorded_sets import synchroniser_of, with_sets
from rig_protocol.recording import (
    CALIBRATION,
    DESCRIPTION,
    HELLOS,
    MANIFEST,
    Recording,
    RecordingWriter,
    part_paths,
)
from rig_protocol.recording_format import AGENT, UTC, ClockReading, DroppedFrames, Entry, RecordedSet, time_of
from rig_protocol.rig_folder import CameraEntry, RigDescription

MERGE = "merge.json"
"""Name of the attachment that tells what was merged."""
_TELL_EVERY = 200  # frames
_SECOND_NS = 1_000_000_000
_LAST_SECOND = 1 << 33  # year 2242
_MAX_COUNT = 2**63 - 1


@dataclass(frozen=True, slots=True)
class MergedPart:
    """What one take gave: frames, and the standard uncertainty of its clock against the common one."""

    path: Path
    frames: int
    typical_uncertainty_ns: int
    worst_uncertainty_ns: int
    torn: bool

    def to_dict(self) -> dict[str, Any]:
        """For `merge.json`."""
        return {
            "file": self.path.name,
            "frames": self.frames,
            "typical_uncertainty_ns": self.typical_uncertainty_ns,
            "worst_uncertainty_ns": self.worst_uncertainty_ns,
            "torn": self.torn,
        }


@dataclass(frozen=True, slots=True)
class Merge:
    """What became of the takes; `clock` is the one that all times are on."""

    clock: str
    parts: tuple[MergedPart, ...]
    frames: int
    sets: int
    not_recorded: int

    def to_dict(self) -> dict[str, Any]:
        """For programs."""
        counts = {"frames": self.frames, "sets": self.sets, "not_recorded": self.not_recorded}
        return {"clock": self.clock, **counts, "takes": [part.to_dict() for part in self.parts]}


@dataclass(frozen=True, slots=True)
class _Take:
    """One take as its first reading found it; `spans_ns`: first and last time stamp of each camera."""

    recording: Recording
    description: RigDescription
    hellos: Mapping[int, Hello]
    clocks: Mapping[str, ClockMap]
    spans_ns: Mapping[int, tuple[int, int]]
    frames: Mapping[int, int]

    @property
    def path(self) -> Path:
        return self.recording.path


def merge_takes(
    paths: Sequence[Path], out: Path, max_spread_ms: float | None = None, progress: Progress | None = None
) -> Merge:
    """Write one take that holds all frames of several; `max_spread_ms` limits its sets, else a frame period.

    Further parts of a take that is given come with it, and may be given, too. ConfigurationError where the
    takes do not go together or `out` exists, DataError for a damaged file, RigError when `out` cannot be
    written; nothing of it is left then.
    """
    tell: Progress = progress or (lambda _stage, _share: None)
    if out.exists():
        raise ConfigurationError(f"{out} exists: a take is never overwritten, give another name")
    further = {part for path in paths for part in part_paths(path)[1:]}
    firsts = [path for path in dict.fromkeys(paths) if path not in further]
    takes = []
    for k, path in enumerate(firsts):
        takes.append(_read(path, k))
        tell("read", (k + 1) / len(firsts))
    clock = common_clock({str(take.path): take.clocks for take in takes})
    placed = [_Placed(take, take.clocks[clock]) for take in takes]
    _check_cameras(placed)
    documents = _documents(takes, clock, [one.part for one in placed])
    with whole_file(out) as output:
        writer = RecordingWriter(output, *_begun(placed, clock), clock.partition("/")[0])
        for name, values in documents.items():
            writer.attach(name, values, placed[0].start_ns)
        frames, sets, lost = _write(writer, placed, documents, max_spread_ms, tell)
        writer.finish(_received(takes), placed[0].start_ns)
    return Merge(clock, tuple(one.part for one in placed), frames, sets, lost)


@dataclass(frozen=True, slots=True)
class _Placed:
    """A take, and the way from its clock to the common one."""

    take: _Take
    clock: ClockMap

    @property
    def start_ns(self) -> int:
        return self._on_clock(self.take.recording.start_ns)

    @property
    def end_ns(self) -> int:
        return self._on_clock(self.take.recording.end_ns)

    @property
    def part(self) -> MergedPart:
        take, places = self.take, [time for span in self.take.spans_ns.values() for time in span]
        worst_ns = max((self.clock.offset_at(time_ns)[1] for time_ns in places), default=0)
        return MergedPart(
            take.path,
            sum(take.frames.values()),
            self.clock.typical_uncertainty_ns,
            worst_ns,
            bool(take.recording.torn),
        )

    def span_ns(self, camera_id: int) -> tuple[int, int]:
        """First and last time stamp of a camera."""
        first_ns, last_ns = self.take.spans_ns[camera_id]
        return self._on_clock(first_ns), self._on_clock(last_ns)

    def entries(self) -> Iterator[tuple[int, Entry]]:
        """What goes on, on the common clock, each with a time that never falls."""
        latest_ns = 0
        for entry in self.take.recording.entries():
            moved = self._moved(entry)
            if moved is not None:
                latest_ns = max(latest_ns, time_of(moved))
                yield latest_ns, moved

    def _moved(self, entry: Entry) -> EncodedFrame | DroppedFrames | None:
        """The entry on the common clock; None for sets, which are made anew, and for clocks, which did it."""
        try:
            if isinstance(entry, EncodedFrame):
                return self.clock.frame(entry)
            return self.clock.dropped(entry) if isinstance(entry, DroppedFrames) else None
        except DataError as error:
            raise DataError(f"{self.take.path}: {error}") from error

    def _on_clock(self, time_ns: int) -> int:
        return min(max(0, time_ns + self.clock.offset_at(time_ns)[0]), LATEST_NS)


def _read(path: Path, number: int) -> _Take:
    """The first reading."""
    recording = Recording(path)
    description = recording.description
    readings: list[ClockReading] = []
    spans_ns: dict[int, tuple[int, int]] = {}
    frames: Counter[int] = Counter()
    for entry in recording.entries():
        if isinstance(entry, ClockReading):
            readings.append(entry)
        elif isinstance(entry, EncodedFrame):
            time_ns, camera_id = entry.timestamp_ns, entry.camera_id
            first_ns, last_ns = spans_ns.get(camera_id, (time_ns, time_ns))
            spans_ns[camera_id] = min(first_ns, time_ns), max(last_ns, time_ns)
            frames[camera_id] += 1
    unknown = sorted(spans_ns.keys() - set(description.camera_ids))
    if unknown:
        raise DataError(f"{path} holds frames of camera {unknown[0]}, of which it tells nothing else")
    own = recording.clock
    # An agent's clock is nobody else's, and neither is one without a name.
    clocks = clock_maps(f"{own or AGENT}/{number}" if own in (None, AGENT) else own, readings)
    hellos = recorded_hellos(recording.document(HELLOS), description)
    return _Take(recording, description, hellos, clocks, spans_ns, frames)


def _check_cameras(placed: Sequence[_Placed]) -> None:
    """ConfigurationError where a slot belongs to two cameras, or one camera is in two takes at a time."""
    for one, other in combinations(placed, 2):
        for camera_id in sorted(one.take.spans_ns.keys() & other.take.spans_ns.keys()):
            names = [_identity(each.take, camera_id) for each in (one, other)]
            files = f"{one.take.path} and {other.take.path}"
            if names[0] != names[1]:
                raise ConfigurationError(
                    f"slot {camera_id} is {names[0]} in {one.take.path} and {names[1]} in {other.take.path}: "
                    "every camera needs a slot of its own (`--camera` of its agent)"
                )
            (first_ns, last_ns), (other_first_ns, other_last_ns) = (
                each.span_ns(camera_id) for each in (one, other)
            )
            if first_ns <= other_last_ns and other_first_ns <= last_ns:
                raise ConfigurationError(f"camera {camera_id} is in {files} at the same time: leave one out")


def _identity(take: _Take, camera_id: int) -> str:
    hello = take.hellos.get(camera_id)
    serial = None if hello is None else hello.serial
    return take.description.camera(camera_id).name if serial is None else f"the camera {serial}"


def _documents(takes: Sequence[_Take], clock: str, parts: Sequence[MergedPart]) -> dict[str, Any]:
    """What is told of the rig: of a camera in several takes what the one says that knows its pose."""
    cameras: dict[int, CameraEntry] = {}
    for entry in (entry for take in takes for entry in take.description.cameras):
        known = cameras.get(entry.id)
        if known is None or (known.T_rig_camera is None and entry.T_rig_camera is not None):
            cameras[entry.id] = entry
    ring = next((take.description.ring for take in takes if take.description.ring is not None), None)
    hellos = {camera_id: hello for take in takes for camera_id, hello in take.hellos.items()}
    documents = {
        DESCRIPTION: RigDescription(tuple(cameras[i] for i in sorted(cameras)), ring).to_dict(),
        HELLOS: told_hellos(hellos),
        MERGE: {"clock": clock, "takes": [part.to_dict() for part in parts]},
    }
    watched = [take.recording for take in takes if CALIBRATION in take.recording.attachments]
    return documents | ({CALIBRATION: watched[-1].document(CALIBRATION)} if watched else {})


def _write(
    writer: RecordingWriter,
    placed: Sequence[_Placed],
    documents: Mapping[str, Any],
    max_spread_ms: float | None,
    tell: Progress,
) -> tuple[int, int, int]:
    """All entries and the sets of them; how many frames, sets and frames that were not recorded."""
    description = RigDescription.from_dict(documents[DESCRIPTION])
    spread_ns = None if max_spread_ms is None else int(max_spread_ms * 1e6)
    synchroniser = synchroniser_of(recorded_hellos(documents[HELLOS], description), max_spread_ns=spread_ns)
    start_ns, end_ns = min(one.start_ns for one in placed), max(one.end_ns for one in placed)
    in_order = heapq.merge(*(one.entries() for one in placed), key=lambda timed: timed[0])
    frames = sets = lost = 0
    for entry in with_sets((entry for _, entry in in_order), synchroniser):
        writer.write(entry)
        frames += isinstance(entry, EncodedFrame)
        sets += isinstance(entry, RecordedSet)
        lost += entry.count if isinstance(entry, DroppedFrames) else 0
        if frames % _TELL_EVERY == 0:
            tell("merge", (time_of(entry) - start_ns) / max(1, end_ns - start_ns))
    return frames, sets, lost


def _received(takes: Sequence[_Take]) -> dict[str, dict[str, int]]:
    """The manifests' counts of what came and what the network lost, summed up; a torn take has none."""
    total: dict[str, Counter[str]] = {}
    for take in takes:
        if MANIFEST not in take.recording.attachments:
            continue
        document = take.recording.document(MANIFEST)
        received = document.get("received") if isinstance(document, Mapping) else None
        for camera_id, counts in (received if isinstance(received, Mapping) else {}).items():
            if not isinstance(counts, Mapping):
                raise DataError(f"{take.path}: {MANIFEST} must hold counts by camera")
            told = {name: integer(counts, name, 0, _MAX_COUNT) for name in ("frames", "lost")}
            total.setdefault(str(camera_id), Counter()).update(told)
    return {camera_id: dict(counts) for camera_id, counts in sorted(total.items())}


def _begun(placed: Sequence[_Placed], clock: str) -> tuple[str, int]:
    """Date and time, and the same moment on the common clock; none where no take tells its date."""
    for one in placed:
        recording, utc_minus_ns = one.take.recording, one.take.recording.utc_minus_rig_time_ns
        if clock == UTC:
            second, rest_ns = divmod(one.start_ns, _SECOND_NS)
        elif utc_minus_ns is not None:
            second, rest_ns = divmod(recording.start_ns + utc_minus_ns, _SECOND_NS)
        else:
            continue
        if 0 <= second < _LAST_SECOND and one.start_ns > rest_ns:
            return datetime.fromtimestamp(second, UTC_ZONE).isoformat(), one.start_ns - rest_ns
    return "", 0
