"""One camera of a rig folder, looped at a given rate as if it were live.

Which frame is shown follows from the clock alone: frame `n` of the loop is due at `n` intervals of the
monotonic clock. Agents on one machine therefore show the same instant of the recording together.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

from rig_agent.sources.base import ColorImage, ControlRefused, ControlValue, DepthImage, SourceDescription
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import RgbdFrame
from rig_protocol.rig_folder import CameraEntry, frame_indices, read_frame, read_rig_description

# Decoded frames kept in memory (1.5 MB a frame): a Pi can spare this; the rest is decoded on every pass.
_CACHE_LIMIT_BYTES = 96 << 20


class FolderSource:
    """A FrameSource that loops over the recorded frames of one camera.

    `camera` is an id or a name of `nominal.json`. ConfigurationError when folder, camera or frames are
    missing, DataError when `nominal.json` or the first frame is malformed.
    """

    def __init__(
        self,
        folder: Path,
        camera: int | str,
        fps: float,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Read the description and the first frame; the others are read when they are due."""
        self._folder = folder
        self._entry = _find_camera(folder, camera)
        self._indices = frame_indices(folder, self._entry.name)
        if not self._indices:
            raise ConfigurationError(f"{folder / self._entry.name} holds no color_*.png")
        self._fps = fps
        self._interval_ns = round(1e9 / fps)
        self._clock, self._sleep = clock, sleep
        self._cache: dict[int, RgbdFrame] = {}
        self._cached_bytes = 0
        self._counters = {"skipped": 0}
        self._kinds = _image_kinds(read_frame(folder, self._entry, self._indices[0]))
        self._next = clock() // self._interval_ns + 1

    @property
    def counters(self) -> Mapping[str, int]:
        """`skipped`: frames that were due while nobody read."""
        return self._counters

    def describe(self) -> SourceDescription:
        """The folder's camera; the rate is the one asked for."""
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
        """The frame that is due next, stamped with the instant it was due; DataError for a torn image."""
        now_ns = self._clock()
        behind = now_ns // self._interval_ns - self._next
        if behind > 0:
            self._counters["skipped"] += behind
        if behind > 0 or behind < -2:  # -1 is on time, less: the clock was set back
            self._next += behind
        wait_s = (self._next * self._interval_ns - now_ns) / 1e9
        if wait_s > timeout_s:
            self._sleep(timeout_s)
            return None
        if wait_s > 0:
            self._sleep(wait_s)
        number, self._next = self._next, self._next + 1
        frame = self._frame(self._indices[number % len(self._indices)])
        return replace(frame, sequence=number, timestamp_ns=number * self._interval_ns)

    def control(self, name: str, value: ControlValue) -> str:
        """There is nothing to set: ControlRefused."""
        raise ControlRefused(f"a recording cannot set {name} to {value}")

    def close(self) -> None:
        """Forget the decoded frames."""
        self._cache.clear()
        self._cached_bytes = 0

    def __enter__(self) -> Self:
        """The source itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        """Close."""
        self.close()

    def _frame(self, index: int) -> RgbdFrame:
        frame = self._cache.get(index)
        if frame is None:
            frame = read_frame(self._folder, self._entry, index)
            self._refuse_change_of_kind(frame)
            size = _byte_size(frame)
            if self._cached_bytes + size <= _CACHE_LIMIT_BYTES:
                self._cache[index] = frame
                self._cached_bytes += size
        return frame

    def _refuse_change_of_kind(self, frame: RgbdFrame) -> None:
        """The codecs were agreed for the first frame's kinds of image; another kind cannot follow."""
        if _image_kinds(frame) != self._kinds:
            raise DataError(
                f"{self._folder / self._entry.name}: frame {frame.sequence} holds {_image_kinds(frame)}, "
                f"the first one {self._kinds}; a camera's frames must be of one kind"
            )


def _find_camera(folder: Path, camera: int | str) -> CameraEntry:
    description = read_rig_description(folder)
    for entry in description.cameras:
        if camera in (entry.id, entry.name):
            return entry
    known = ", ".join(f"{entry.id} ({entry.name})" for entry in description.cameras)
    raise ConfigurationError(f"{folder} has no camera {camera}; it has {known or 'none'}")


def _image_kinds(frame: RgbdFrame) -> tuple[ColorImage | None, DepthImage | None]:
    color: ColorImage | None = None
    if frame.color is not None:
        color = "bgr" if frame.color.ndim == 3 else "grey"
    depth: DepthImage | None = None
    if frame.raw is not None:
        depth = "raw"
    elif frame.depth_mm is not None:
        depth = "depth_mm"
    return color, depth


def _byte_size(frame: RgbdFrame) -> int:
    return sum(image.nbytes for image in (frame.color, frame.raw, frame.depth_mm) if image is not None)
