"""What stands in a recording: frames as they came, the sets that were made of them, and what was dropped.

docs/recording.md describes it for other programs. Messages are MessagePack maps; what a file says is hostile.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import msgpack

from rig_protocol.errors import DataError
from rig_protocol.frame_unit import MAX_UNIT_SIZE
from rig_protocol.frames import EncodedFrame, PanoramicFrame, Payload
from rig_protocol.gravity import Gravity
from rig_protocol.message_fields import Fields, flag, integer, optional, text, unpack_map

VERSION = 1
PROFILE = "kinect-rig"
TAKE = "kinect-rig.take"
"""Name of the metadata record that tells the version of this format."""

SETS, DROPS, CLOCK = "/sets", "/drops", "/clock"
MAX_CAMERA_ID = 255
UTC, AGENT = "utc", "agent"
"""Names of clocks: of the world, and an agent's own, which is nobody else's."""
MAX_CLOCK_NAME = 32
_MAX_TIES = 8
_IMAGE_TOPIC = re.compile(r"/cam(\d{2,3})/(color|depth)")
_MAX_TIME = 2**63 - 1
_MAX_NUMBER = 2**64 - 1


@dataclass(frozen=True, slots=True)
class RecordedSet:
    """A set as it went out: for every expected camera the time stamp of its frame, None where it had none."""

    index: int
    taken_ns: int
    timestamps_ns: Mapping[int, int | None]

    @classmethod
    def of(cls, panorama: PanoramicFrame, taken_ns: int) -> "RecordedSet":
        """The set that a panoramic frame is."""
        frames = panorama.frames.items()
        return cls(panorama.index, taken_ns, {i: None if f is None else f.timestamp_ns for i, f in frames})


@dataclass(frozen=True, slots=True)
class DroppedFrames:
    """Frames of one camera that the disk was too slow for: how many, the first and the last time stamp."""

    camera_id: int
    count: int
    first_ns: int
    last_ns: int


@dataclass(frozen=True, slots=True)
class ClockTie:
    """Another clock's time is the take's and `offset_ns`, with its standard uncertainty.

    `clock`: `utc`, or a server's monotonic clock since it was booted, as the server calls it (`rig:...`).
    """

    clock: str
    offset_ns: int
    uncertainty_ns: int


@dataclass(frozen=True, slots=True)
class ClockReading:
    """The take's clock at one of its moments against those that are known then."""

    time_ns: int
    ties: tuple[ClockTie, ...]


Entry = EncodedFrame | RecordedSet | DroppedFrames | ClockReading


def time_of(entry: Entry) -> int:
    """When an entry became known to who records, in the take's clock: the order of a recording."""
    match entry:
        case EncodedFrame():
            return max(0, entry.timestamp_ns if entry.received_ns is None else entry.received_ns)
        case RecordedSet():
            return entry.taken_ns
        case DroppedFrames():
            return max(0, entry.last_ns)
        case ClockReading():
            return max(0, entry.time_ns)


def pack_entry(entry: Entry) -> list[tuple[str, bytes]]:
    """The messages of an entry, each with its topic: a frame is one message a stream, colour first."""
    match entry:
        case EncodedFrame():
            return _pack_frame(entry)
        case RecordedSet():
            frames = [[camera_id, time_ns] for camera_id, time_ns in entry.timestamps_ns.items()]
            return [(SETS, _pack(index=entry.index, taken_ns=entry.taken_ns, frames=frames))]
        case DroppedFrames():
            values = {name: getattr(entry, name) for name in ("camera_id", "count", "first_ns", "last_ns")}
            return [(DROPS, _pack(**values))]
        case ClockReading():
            ties = [[tie.clock, tie.offset_ns, tie.uncertainty_ns] for tie in entry.ties]
            return [(CLOCK, _pack(time_ns=entry.time_ns, ties=ties))]


class EntryParser:
    """Messages back to entries. A frame of two streams comes with its second message."""

    def __init__(self) -> None:
        self._half: EncodedFrame | None = None

    def parse(self, topic: str, data: bytes) -> Entry | None:
        """The entry that this message completes; None for a first half and for topics of other programs.

        DataError when it breaks the format.
        """
        try:
            if topic == SETS:
                return _parse_set(unpack_map(data))
            if topic == DROPS:
                return _parse_drops(unpack_map(data))
            if topic == CLOCK:
                return _parse_clock(unpack_map(data))
            match = _IMAGE_TOPIC.fullmatch(topic)
            return None if match is None else self._parse_image(int(match[1]), match[2], data)
        except DataError as error:
            raise DataError(f"a message of {topic} breaks the format: {error}") from error

    def _parse_image(self, camera_id: int, stream: str, data: bytes) -> EncodedFrame | None:
        values = unpack_map(data)
        frame = _parse_frame(values, camera_id, stream)
        first, self._half = self._half, None
        if stream == "depth" and flag(values, "pair"):
            # Whose first half is lost (the file was torn there) is no whole frame.
            if first is None or (first.camera_id, first.timestamp_ns) != (camera_id, frame.timestamp_ns):
                return None
            return replace(frame, color=first.color)
        if stream == "color" and flag(values, "pair"):
            self._half = frame
            return None
        return frame


def image_schema() -> bytes:
    """JSON Schema of a message of /camNN/color and /camNN/depth."""
    kinds = {
        "sequence": "integer",
        "timestamp_ns": "integer",
        "uncertainty_ns": "integer",
        "received_ns": ["integer", "null"],
        "codec": "integer",
        "data": "string",
        "pair": "boolean",
        "damaged": "boolean",
        "depth_frame": "string",
        "gravity": ["object", "null"],
    }
    return _schema("kinect_rig.EncodedImage", kinds)


def set_schema() -> bytes:
    """JSON Schema of a message of /sets."""
    return _schema("kinect_rig.Set", {"index": "integer", "taken_ns": "integer", "frames": "array"})


def drop_schema() -> bytes:
    """JSON Schema of a message of /drops."""
    return _schema(
        "kinect_rig.DroppedFrames", dict.fromkeys(("camera_id", "count", "first_ns", "last_ns"), "integer")
    )


def clock_schema() -> bytes:
    """JSON Schema of a message of /clock."""
    return _schema("kinect_rig.Clock", {"time_ns": "integer", "ties": "array"})


def _schema(title: str, kinds: Mapping[str, Any]) -> bytes:
    properties = {name: {"type": kind} for name, kind in kinds.items()}
    return json.dumps({"title": title, "type": "object", "properties": properties}).encode()


def _pack_frame(frame: EncodedFrame) -> list[tuple[str, bytes]]:
    streams = {"color": frame.color, "depth": frame.depth}
    present = {name: payload for name, payload in streams.items() if payload is not None}
    return [
        (
            f"/cam{frame.camera_id:02d}/{name}",
            _pack(
                sequence=frame.sequence,
                timestamp_ns=frame.timestamp_ns,
                uncertainty_ns=frame.uncertainty_ns,
                received_ns=frame.received_ns,
                codec=payload.codec_id,
                data=payload.data,
                pair=len(present) == 2,
                damaged=frame.damaged,
                depth_frame=frame.depth_frame,
                gravity=None if frame.gravity is None else frame.gravity.to_dict(),
            ),
        )
        # A frame without any image is a frame all the same: codec 0.
        for name, payload in (present or {"color": Payload(0, b"")}).items()
    ]


def _parse_frame(values: Fields, camera_id: int, stream: str) -> EncodedFrame:
    data, depth_frame, gravity = values.get("data"), text(values, "depth_frame", 8), values.get("gravity")
    if not isinstance(data, bytes) or len(data) > MAX_UNIT_SIZE:
        raise DataError(f"data must be at most {MAX_UNIT_SIZE} bytes")
    if depth_frame not in ("depth", "color") or camera_id > MAX_CAMERA_ID:
        raise DataError("depth_frame must be `depth` or `color`, and a camera's id at most 255")
    codec_id = integer(values, "codec", 0, 255)
    payload = Payload(codec_id, data) if codec_id else None
    return EncodedFrame(
        camera_id=camera_id,
        sequence=integer(values, "sequence", 0, _MAX_NUMBER),
        timestamp_ns=integer(values, "timestamp_ns", -_MAX_TIME, _MAX_TIME),
        uncertainty_ns=integer(values, "uncertainty_ns", 0, _MAX_NUMBER),
        color=payload if stream == "color" else None,
        depth=payload if stream == "depth" else None,
        depth_frame="color" if depth_frame == "color" else "depth",
        damaged=flag(values, "damaged"),
        received_ns=optional(integer, values, "received_ns", 0, _MAX_TIME),
        gravity=None if gravity is None else Gravity.from_dict(gravity),
    )


def _parse_set(values: Fields) -> RecordedSet:
    frames = values.get("frames")
    if not isinstance(frames, list) or not 0 < len(frames) <= MAX_CAMERA_ID + 1:
        raise DataError("frames must list the cameras of the set")
    timestamps_ns: dict[int, int | None] = {}
    for item in frames:
        if not isinstance(item, list) or len(item) != 2:
            raise DataError("frames must hold pairs of a camera and a time stamp")
        fields = {"camera": item[0], "time": item[1]}
        camera_id = integer(fields, "camera", 0, MAX_CAMERA_ID)
        timestamps_ns[camera_id] = optional(integer, fields, "time", -_MAX_TIME, _MAX_TIME)
    return RecordedSet(
        integer(values, "index", 0, _MAX_TIME), integer(values, "taken_ns", 0, _MAX_TIME), timestamps_ns
    )


def _parse_drops(values: Fields) -> DroppedFrames:
    return DroppedFrames(
        integer(values, "camera_id", 0, MAX_CAMERA_ID),
        integer(values, "count", 1, _MAX_NUMBER),
        integer(values, "first_ns", -_MAX_TIME, _MAX_TIME),
        integer(values, "last_ns", -_MAX_TIME, _MAX_TIME),
    )


def _parse_clock(values: Fields) -> ClockReading:
    ties = values.get("ties")
    if not isinstance(ties, list) or len(ties) > _MAX_TIES:
        raise DataError(f"ties must list at most {_MAX_TIES} clocks")
    return ClockReading(integer(values, "time_ns", -_MAX_TIME, _MAX_TIME), tuple(map(_parse_tie, ties)))


def _parse_tie(item: Any) -> ClockTie:
    if not isinstance(item, list) or len(item) != 3:
        raise DataError("ties must hold a clock, its offset and the uncertainty of that")
    fields = dict(zip(("clock", "offset_ns", "uncertainty_ns"), item, strict=True))
    return ClockTie(
        text(fields, "clock", MAX_CLOCK_NAME),
        integer(fields, "offset_ns", -_MAX_TIME, _MAX_TIME),
        integer(fields, "uncertainty_ns", 0, _MAX_TIME),
    )


def _pack(**values: Any) -> bytes:
    return bytes(msgpack.packb(values))
