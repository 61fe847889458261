"""A take as MCAP: what every camera sent, as it came, and what the server made of it (docs/recording.md).

FILE is the first part of a take; where it was split, FILE.001.mcap and so on go on. Every part stands alone.
"""

import fcntl
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol

from rig_protocol.errors import DataError, RigError
from rig_protocol.mcap_scan import ChunkPlace, Contents, chunk_messages, open_recording, scan, topic_messages
from rig_protocol.recording_format import (
    CLOCK,
    DROPS,
    PROFILE,
    SETS,
    TAKE,
    VERSION,
    DroppedFrames,
    Entry,
    EntryParser,
    RecordedSet,
    clock_schema,
    drop_schema,
    image_schema,
    pack_entry,
    set_schema,
    time_of,
)
from rig_protocol.rig_folder import RigDescription

DESCRIPTION, HELLOS, SETTINGS = "nominal.json", "hellos.json", "settings.json"
CALIBRATION, MANIFEST = "calibration.json", "drops.json"
"""Names of the attachments."""

# A chunk that a kill tears is lost whole: it is ended when it is so large, and at every flush.
_CHUNK_BYTES = 4 << 20
_MAX_PARTS = 10_000


class Output(Protocol):
    """Where a writer writes to: a binary file, or what behaves like one."""

    def write(self, data: bytes, /) -> int:
        """Write all of it."""
        ...

    def tell(self) -> int:
        """How much was written."""
        ...

    def flush(self) -> None:
        """Hand what is buffered to the operating system."""
        ...


class RecordingWriter:
    """Writes one part of a take; errors are the output's own.

    What was flushed survives the end of this process. `finish` adds the indexes that make any reader quick.
    """

    def __init__(self, output: Output, created: str, now_ns: int, clock: str | None = None) -> None:
        """`created`: date and time in words (ISO 8601); `now_ns`: the same moment in the take's clock.

        `clock`: the name of that clock, where others may know it.
        """
        from mcap.writer import CompressionType, Writer

        self._output = output
        # The payloads are compressed already.
        stream: Any = output  # the library asks for a whole IO, and uses what Output has
        self._writer: Any = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(profile=PROFILE, library=PROFILE)
        about = {"version": str(VERSION), "created": created, "created_rig_time_ns": str(now_ns)}
        if clock is not None:
            about["clock"] = clock
        self._writer.add_metadata(TAKE, about)
        self._channels: dict[str, int] = {}
        self._attached: dict[str, bytes] = {}
        self._schemas: dict[str, int] = {}
        self._drops: dict[int, dict[str, int]] = {}

    @property
    def size(self) -> int:
        """Bytes that stand in the output; a chunk in progress does not yet."""
        return self._output.tell()

    def write(self, entry: Entry) -> None:
        """Add an entry, behind what was written before."""
        for topic, data in pack_entry(entry):
            # The two messages of a frame share their time, which keeps them together in any order.
            self._writer.add_message(self._channel(topic), time_of(entry), data, time_of(entry))
        if isinstance(entry, DroppedFrames):
            dropped = self._drops.setdefault(entry.camera_id, {"frames": 0, "times": 0})
            dropped["frames"] += entry.count
            dropped["times"] += 1

    def attach(self, name: str, values: Any, now_ns: int) -> None:
        """Attach a JSON document, unless the same one was attached under this name last."""
        data = json.dumps(values, indent=1, sort_keys=True).encode()
        if self._attached.get(name) != data:
            self._attached[name] = data
            self._writer.add_attachment(now_ns, now_ns, name, "application/json", data)

    def flush(self) -> None:
        """End the chunk in progress and hand it to the operating system."""
        self._writer.flush()

    def finish(self, cameras: Mapping[str, Mapping[str, int]] | None = None, now_ns: int = 0) -> None:
        """Write the manifest of drops and the indexes; `cameras`: more counts by camera, for the manifest."""
        dropped = {str(camera_id): counts for camera_id, counts in sorted(self._drops.items())}
        self._writer.flush()
        self.attach(MANIFEST, {"not_recorded": dropped, "received": dict(cameras or {})}, now_ns)
        self._writer.finish()
        self._output.flush()

    def _channel(self, topic: str) -> int:
        channel = self._channels.get(topic)
        if channel is None:
            schema = self._schema(topic)
            channel = self._channels[topic] = self._writer.register_channel(topic, "msgpack", schema)
        return channel

    def _schema(self, topic: str) -> int:
        name, make = _SCHEMAS.get(topic, ("kinect_rig.EncodedImage", image_schema))
        schema = self._schemas.get(name)
        if schema is None:
            schema = self._schemas[name] = self._writer.register_schema(name, "jsonschema", make())
        return schema


_SCHEMAS: dict[str, tuple[str, Callable[[], bytes]]] = {
    SETS: ("kinect_rig.Set", set_schema),
    DROPS: ("kinect_rig.DroppedFrames", drop_schema),
    CLOCK: ("kinect_rig.Clock", clock_schema),
}


@dataclass(frozen=True, slots=True)
class _Part:
    path: Path
    contents: Contents


class Recording:
    """A take to read, all its parts.

    ConfigurationError when there is no such file, DataError when it is no recording of this format.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._parts = [_Part(part, _checked(part)) for part in part_paths(path)]

    @property
    def torn(self) -> tuple[Path, ...]:
        """The parts that were not finished: what was flushed is read, the summary is absent."""
        return tuple(part.path for part in self._parts if not part.contents.sound)

    @property
    def clock(self) -> str | None:
        """Name of the clock of all its times; None where it was not told."""
        return self._parts[0].contents.metadata[TAKE].get("clock")

    @property
    def start_ns(self) -> int:
        """Rig time of the first entry; DataError when there is none."""
        return min(chunk.start_ns for chunk in self._chunks())

    @property
    def end_ns(self) -> int:
        """Rig time of the last entry."""
        return max(chunk.end_ns for chunk in self._chunks())

    @property
    def utc_minus_rig_time_ns(self) -> int | None:
        """What makes Unix time of rig time, to a second; None where the take does not tell its date."""
        about = self._parts[0].contents.metadata[TAKE]
        rig_time_ns = _created_rig_time_ns(about)
        try:
            created = datetime.fromisoformat(about.get("created", ""))
        except ValueError:
            return None
        if rig_time_ns == 0 or created.tzinfo is None:
            return None
        return round(created.timestamp()) * 1_000_000_000 - rig_time_ns

    @property
    def attachments(self) -> dict[str, bytes]:
        """By name; the last of a name counts."""
        return {name: data for part in self._parts for name, data in part.contents.attachments.items()}

    @property
    def description(self) -> RigDescription:
        """The cameras of the take; DataError when it does not tell them."""
        return RigDescription.from_dict(self.document(DESCRIPTION))

    @property
    def has_sets(self) -> bool:
        """Whether the server's sets were recorded."""
        if any(SETS in part.contents.topics.values() for part in self._parts):
            return True
        return bool(self.torn) and next(self.sets(), None) is not None

    def document(self, name: str) -> Any:
        """An attached JSON document; DataError when it is absent or malformed."""
        data = self.attachments.get(name)
        if data is None:
            raise DataError(f"{self.path} has no {name}: it ended before a camera came")
        try:
            return json.loads(data)
        except (ValueError, RecursionError) as error:
            raise DataError(f"{self.path}: {name} is not valid JSON: {error}") from error

    def entries(self, from_ns: int = 0) -> Iterator[Entry]:
        """All entries from a rig time on, in the order in which they were written.

        DataError where the file is damaged.
        """
        for part in self._parts:
            yield from _entries_of(part.path, part.contents, from_ns)

    def sets(self) -> Iterator[RecordedSet]:
        """The sets alone, in the order in which they were written: of what is indexed no image is read.

        Thereafter `entries` skips to a time in parts that were not finished, too. DataError where the file is
        damaged and that shows: check sums are for `entries`.
        """
        for part in self._parts:
            yield from _sets_of(part.path, part.contents)

    def _chunks(self) -> list[ChunkPlace]:
        chunks = [chunk for part in self._parts for chunk in part.contents.chunks]
        if not chunks:
            raise DataError(f"{self.path} holds no frames")
        return chunks


def part_path(path: Path, number: int) -> Path:
    """The file of a part; FILE itself is part 0."""
    return path if number == 0 else path.with_name(f"{path.stem}.{number:03d}{path.suffix}")


def part_paths(path: Path) -> list[Path]:
    """The parts of a take that exist, in order; the first one in any case."""
    further = (part_path(path, number) for number in range(1, _MAX_PARTS))
    parts = [path]
    for part in further:
        if not part.is_file():
            break
        parts.append(part)
    return parts


def recover(path: Path) -> list[Path]:
    """Rewrite the parts of a take that are torn or damaged, each kept as FILE.torn; those rewritten.

    ConfigurationError where a file cannot be read or written, DataError for what is no recording, RigError
    while it is being recorded.
    """
    for part in part_paths(path):
        _refuse_while_recorded(part)
    return [part for part in part_paths(path) if _recover_part(part)]


def _refuse_while_recorded(path: Path) -> None:
    with closing(open_recording(path)) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RigError(f"{path} is being recorded: end that first") from error
        except OSError:  # some network disks have no locks
            return


def _recover_part(path: Path) -> bool:
    contents = _checked(path)
    if contents.sound and _reads_well(path, contents):
        return False
    fresh, kept = path.with_name(f"{path.name}.recovering"), path.with_name(f"{path.name}.torn")
    try:
        with fresh.open("wb") as output:
            _rewrite(path, contents, output)
        path.replace(kept)
        fresh.replace(path)
    except OSError as error:
        fresh.unlink(missing_ok=True)
        raise RigError(f"{fresh} cannot be written: {error.strerror}; {path} is as it was") from error
    return True


def _rewrite(path: Path, contents: Contents, output: Any) -> None:
    about = contents.metadata[TAKE]
    writer = RecordingWriter(
        output, about.get("created", ""), _created_rig_time_ns(about), about.get("clock")
    )
    for name, data in contents.attachments.items():
        try:
            writer.attach(name, json.loads(data), 0)
        except (ValueError, RecursionError):  # what nobody can read is not worth keeping
            continue
    for entry in _entries_of(path, contents, 0, leave_out_damaged=True):
        writer.write(entry)
    writer.finish()


def _created_rig_time_ns(about: Mapping[str, str]) -> int:
    """Rig time at which a take began; 0 where it does not tell."""
    told = about.get("created_rig_time_ns", "")
    return int(told) if told.isdecimal() and len(told) < 20 else 0


def _reads_well(path: Path, contents: Contents) -> bool:
    try:
        for _ in _entries_of(path, contents, 0):
            pass
    except DataError:
        return False
    return True


def _checked(path: Path) -> Contents:
    """The contents of a file of our format and version."""
    contents = scan(path)
    about = contents.metadata.get(TAKE)
    if about is None:
        raise DataError(f"{path} is an MCAP file, but no recording of a rig: it has no {TAKE}")
    if about.get("version") != str(VERSION):
        raise DataError(f"{path} is of format {about.get('version')}, this release reads {VERSION}")
    return contents


def _entries_of(
    path: Path, contents: Contents, from_ns: int, leave_out_damaged: bool = False
) -> Iterator[Entry]:
    topics, parser = dict(contents.topics), EntryParser()
    with closing(open_recording(path)) as file:
        for place in contents.chunks:
            # As long as the channels are unknown, every chunk must be read: they declare them.
            if contents.topics and place.end_ns < from_ns:
                continue
            try:
                entries = [
                    parser.parse(topic, data)
                    for topic, time_ns, data in chunk_messages(file, place, topics, path)
                    if time_ns >= from_ns
                ]
            except DataError as error:
                if leave_out_damaged:
                    continue
                raise _damaged(path, place, error) from error
            yield from (entry for entry in entries if entry is not None)


def _sets_of(path: Path, contents: Contents) -> Iterator[RecordedSet]:
    topics, parser = dict(contents.topics), EntryParser()
    with closing(open_recording(path)) as file:
        for place in contents.chunks:
            try:
                found = [parser.parse(SETS, data) for data in topic_messages(file, place, SETS, topics, path)]
            except DataError as error:
                raise _damaged(path, place, error) from error
            yield from (entry for entry in found if isinstance(entry, RecordedSet))
    contents.topics |= topics


def _damaged(path: Path, place: ChunkPlace, error: DataError) -> DataError:
    return DataError(f"{path}, at byte {place.offset}: {error}")
