"""One camera of a recorded take, looped at the pace of the recording as if it were live.

What is shown follows from the clock alone: the take begins at whole multiples of its length. Agents on one
machine therefore show the same moment of it together.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

from rig_agent.sources.base import ColorImage, ControlRefused, ControlValue, DepthImage, SourceDescription
from rig_protocol.codecs import ImageKind, codec
from rig_protocol.decoding import decode_frame
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import EncodedFrame, Payload, RgbdFrame
from rig_protocol.recording import HELLOS, Recording
from rig_protocol.rig_folder import CameraEntry

_GAP_NS = 33_333_333  # between the last frame and the first one of the next round
_LATE_NS = 200_000_000  # a frame so long due is skipped
_DEFAULT_FPS = 30.0


class RecordingSource:
    """A FrameSource that loops over the frames of one camera, by id or name.

    ConfigurationError when file or camera are missing, DataError when the file is no recording or damaged.
    """

    def __init__(
        self,
        take: Path,
        camera: int | str,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._recording = Recording(take)
        self._entry = _find_camera(self._recording, camera)
        self._start_ns = self._recording.start_ns
        self._period_ns = self._recording.end_ns - self._start_ns + _GAP_NS
        self._clock, self._sleep = clock, sleep
        self._counters = {"skipped": 0}
        first = next(self._frames(0), None)
        if first is None:
            raise ConfigurationError(f"{take} holds no frames of camera {self._entry.name}")
        self._kinds = _color(_kind(first.color)), _depth(_kind(first.depth))
        self._fps = _rate(self._recording, self._entry.id)
        self._round, into_ns = divmod(clock(), self._period_ns)
        self._coming = self._frames(self._start_ns + into_ns)
        self._next: EncodedFrame | None = None
        self._sequence = 0

    @property
    def counters(self) -> Mapping[str, int]:
        """`skipped`: frames that were due while nobody read."""
        return self._counters

    def describe(self) -> SourceDescription:
        """The recorded camera, as its agent told it."""
        color, depth = self._kinds
        return SourceDescription(
            serial=None,
            port_path=None,
            model=self._entry.model,
            fps=self._fps,
            color_image=color,
            depth_image=depth,
            camera_id=self._entry.id,
        )

    def read(self, timeout_s: float) -> RgbdFrame | None:
        """The frame that is due next, stamped with its time in this round; DataError for a damaged file."""
        now_ns = self._clock()
        if self._round < now_ns // self._period_ns - 1:  # nobody read for a whole round
            self._begin_round(now_ns // self._period_ns)
        frame, due_ns = self._due()
        while due_ns < now_ns - _LATE_NS:
            self._next = None
            self._counters["skipped"] += 1
            frame, due_ns = self._due()
        wait_s = (due_ns - now_ns) / 1e9
        self._sleep(max(0.0, min(wait_s, timeout_s)))
        if wait_s > timeout_s:
            return None
        self._next = None
        self._sequence += 1
        decoded = decode_frame(frame)
        return replace(decoded, sequence=self._sequence, timestamp_ns=due_ns, received_ns=None)

    def control(self, name: str, value: ControlValue) -> str:
        """There is nothing to set: ControlRefused."""
        raise ControlRefused(f"a recording cannot set {name} to {value}")

    def close(self) -> None:
        """Nothing is held between two frames but the file, which the end of reading closes."""

    def __enter__(self) -> Self:
        """The source itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        """Close."""
        self.close()

    def _due(self) -> tuple[EncodedFrame, int]:
        """The next frame and when it is due, in agent time."""
        while self._next is None:
            self._next = next(self._coming, None)
            if self._next is None:
                self._begin_round(self._round + 1)
        return self._next, self._round * self._period_ns + self._next.timestamp_ns - self._start_ns

    def _begin_round(self, number: int) -> None:
        self._round, self._next = number, None
        self._coming = self._frames(0)

    def _frames(self, from_ns: int) -> Iterator[EncodedFrame]:
        for entry in self._recording.entries(from_ns):
            if isinstance(entry, EncodedFrame) and entry.camera_id == self._entry.id:
                yield entry


def _find_camera(recording: Recording, camera: int | str) -> CameraEntry:
    entries = recording.description.cameras
    for entry in entries:
        if camera in (entry.id, entry.name):
            return entry
    known = ", ".join(f"{entry.id} ({entry.name})" for entry in entries)
    raise ConfigurationError(f"{recording.path} has no camera {camera}; it has {known or 'none'}")


def _kind(payload: Payload | None) -> ImageKind | None:
    return None if payload is None else codec(payload.codec_id).image


def _color(kind: ImageKind | None) -> ColorImage | None:
    if kind == "raw" or kind == "depth_mm":
        raise DataError(f"the colour of the recording is in a codec of {kind}")
    return kind


def _depth(kind: ImageKind | None) -> DepthImage | None:
    if kind is None or kind == "raw" or kind == "depth_mm":
        return kind
    raise DataError(f"the depth of the recording is in a codec of {kind}")


def _rate(recording: Recording, camera_id: int) -> float:
    """What the camera's agent said; DataError when the file tells nonsense."""
    try:
        agents = recording.document(HELLOS)["agents"]
        fps = next((float(one["fps"]) for one in agents if one["camera_id"] == camera_id), _DEFAULT_FPS)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{recording.path}: {HELLOS} is malformed: {error!r}") from error
    return fps if 0.1 <= fps <= 240 else _DEFAULT_FPS
