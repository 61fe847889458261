"""Colour and depth images that belong together, by the device's own clock."""

from dataclasses import dataclass
from typing import Literal

from rig_agent.sources.device_clock import TICK_HZ, tick_difference
from rig_protocol.frames import ImageU8, ImageU16

Stream = Literal["video", "depth"]

_HALF_FRAME_TICKS = TICK_HZ // 30 // 2


@dataclass(frozen=True, slots=True, eq=False)
class StreamImage:
    """One image as the driver delivered it; `ticks` of its last packet, `arrival_ns` in agent time."""

    stream: Stream
    ticks: int
    arrival_ns: int
    image: ImageU8 | ImageU16
    damaged: bool


@dataclass(frozen=True, slots=True, eq=False)
class ImagePair:
    """Depth and colour of one instant; no depth while its stream is off."""

    depth: StreamImage | None
    video: StreamImage

    @property
    def clocked(self) -> StreamImage:
        """The image whose time is the pair's."""
        return self.video if self.depth is None else self.depth

    @property
    def damaged(self) -> bool:
        """True when a part of either is missing."""
        return self.video.damaged or (self.depth is not None and self.depth.damaged)


class FramePairer:
    """Pairs images whose ticks lie within half a frame; at most one image waits for its partner."""

    def __init__(self) -> None:
        """Nothing waits yet."""
        self.unpaired = 0
        self._waiting: StreamImage | None = None
        self._with_depth = True

    def start_anew(self, with_depth: bool) -> None:
        """The streams were switched: what waits has no partner to come, and that is no fault."""
        self._waiting, self._with_depth = None, with_depth

    def add(self, image: StreamImage) -> ImagePair | None:
        """The pair that this image completes, if it does; an image whose partner cannot come is counted."""
        if not self._with_depth:
            return ImagePair(None, image) if image.stream == "video" else None
        waiting = self._waiting
        if waiting is None:
            self._waiting = image
            return None
        lead = tick_difference(image.ticks, waiting.ticks)
        if waiting.stream != image.stream and abs(lead) <= _HALF_FRAME_TICKS:
            self._waiting = None
            return ImagePair(image, waiting) if image.stream == "depth" else ImagePair(waiting, image)
        self.unpaired += 1
        if waiting.stream == image.stream or lead > 0:
            self._waiting = image
        return None
