"""The frames that flow through the rig: decoded, encoded, panoramic.

Three clocks are kept apart by name: `device_ticks` (60 MHz in the Kinect), `agent_time_ns`
(the Pi's monotonic clock) and `timestamp_ns` (the rig clock, which is the server's monotonic clock).
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
import numpy.typing as npt

from rig_protocol.gravity import Gravity

ImageU8 = npt.NDArray[np.uint8]
ImageU16 = npt.NDArray[np.uint16]

DepthFrame = Literal["depth", "color"]
"""The camera whose pixel grid a depth image lives on; `color` means registered."""

NO_DISPARITY = 2047
"""Raw 11-bit value of a pixel without a measurement."""

NO_DEPTH_MM = 0
"""Millimetre value of a pixel without a measurement."""


@dataclass(frozen=True, slots=True)
class RgbdFrame:
    """One camera's colour and depth of one instant.

    Colour is either `bayer` (H,W) u8, GRBG, or `color` (H,W,3) BGR or (H,W) grey u8; a server that was
    asked to demosaic gives both.
    Depth is either `raw` (H,W) u16 11-bit disparity, 2047 = none, or `depth_mm` (H,W) u16, 0 = none.
    `received_ns`: rig time at which its last datagram was here; None where it crossed no network.
    `gravity`: down as the camera felt it then or seconds before; None where it has no accelerometer.
    """

    camera_id: int
    sequence: int
    timestamp_ns: int
    uncertainty_ns: int = 0
    bayer: ImageU8 | None = None
    color: ImageU8 | None = None
    raw: ImageU16 | None = None
    depth_mm: ImageU16 | None = None
    depth_frame: DepthFrame = "depth"
    damaged: bool = False
    received_ns: int | None = None
    gravity: Gravity | None = None


@dataclass(frozen=True, slots=True)
class Payload:
    """One encoded image: the codec's wire id and its bytes."""

    codec_id: int
    data: bytes | memoryview


@dataclass(frozen=True, slots=True)
class EncodedFrame:
    """An RgbdFrame as it crosses the wire; either payload may be absent.

    `timestamp_ns` is agent time on the agent and rig time once the server's link has delivered the frame;
    from then on `received_ns` is the rig time at which its last datagram was here, and `gravity` what the
    latest heartbeat told.
    """

    camera_id: int
    sequence: int
    timestamp_ns: int
    uncertainty_ns: int = 0
    color: Payload | None = None
    depth: Payload | None = None
    depth_frame: DepthFrame = "depth"
    damaged: bool = False
    received_ns: int | None = None
    gravity: Gravity | None = None


@dataclass(frozen=True, slots=True)
class PanoramicFrame:
    """One synchronised set: a frame, or None where it is missing, for every expected camera.

    `timestamp_ns` is the mean exposure time; `spread_ns` is the latest minus the earliest.
    `uncertainty_ns` is the largest standard uncertainty among its frames' times: two exposures of the set
    are known against each other, and so is the spread, to √2 of it or better.
    """

    index: int
    timestamp_ns: int
    frames: Mapping[int, RgbdFrame | None]
    spread_ns: int
    uncertainty_ns: int = 0

    @classmethod
    def of(cls, index: int, frames: Mapping[int, RgbdFrame | None]) -> Self:
        """The set of these frames, its times computed; ValueError when it holds none."""
        present = [frame for frame in frames.values() if frame is not None]
        if not present:
            raise ValueError(f"set {index} holds no frame")
        times_ns = [frame.timestamp_ns for frame in present]
        return cls(
            index=index,
            timestamp_ns=mean_time_ns(present),
            frames=frames,
            spread_ns=max(times_ns) - min(times_ns),
            uncertainty_ns=max(frame.uncertainty_ns for frame in present),
        )

    @property
    def missing(self) -> tuple[int, ...]:
        """Ids of the cameras without a frame in this set, ascending."""
        return tuple(sorted(camera_id for camera_id, frame in self.frames.items() if frame is None))

    @property
    def complete(self) -> bool:
        """True when every expected camera delivered."""
        return not self.missing


def mean_time_ns(frames: Collection[RgbdFrame]) -> int:
    """Mean exposure time of at least one frame, rounded down."""
    return sum(frame.timestamp_ns for frame in frames) // len(frames)
