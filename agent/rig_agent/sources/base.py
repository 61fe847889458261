"""What every driver of cameras offers to the agent, whether hardware, folder or simulator."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Protocol, Self

from rig_protocol.camera import CameraModel
from rig_protocol.errors import RigError
from rig_protocol.frames import RgbdFrame
from rig_protocol.troubleshooting import Topic

ColorImage = Literal["bayer", "bgr", "grey"]
DepthImage = Literal["raw", "depth_mm"]
ControlValue = bool | float | str


class SourceLost(RigError):  # noqa: N818  # it reads as what happened: the source is lost
    """The device died or cannot be opened now: close the source, wait, open it again."""

    topic = Topic.NO_FRAMES


class ControlRefused(RigError):  # noqa: N818  # as above
    """The source does not have this control, or not this value; the text says which it has."""


@dataclass(frozen=True, slots=True, eq=False)
class SourceDescription:
    """Who the device is and what it delivers; None for an image that it does not deliver.

    `camera_id` is the slot that a recording remembers; a live device knows none.
    """

    serial: str | None
    port_path: str | None
    model: CameraModel
    fps: float
    color_image: ColorImage | None
    depth_image: DepthImage | None
    camera_id: int | None = None


class FrameSource(Protocol):
    """An open camera. Its factory opens it: ConfigurationError for a wrong setting, SourceLost for no device.

    One thread uses a source at a time; `close` comes last.
    """

    @property
    def counters(self) -> Mapping[str, int]:
        """What went wrong so far, by cause; names are for the operator."""
        ...

    def describe(self) -> SourceDescription:
        """Constant while the source is open."""
        ...

    def read(self, timeout_s: float) -> RgbdFrame | None:
        """The next frame, stamped in agent time (CLOCK_MONOTONIC, ns), or None after `timeout_s`.

        The agent replaces `camera_id`. `gravity` is what an accelerometer feels now; None where there is none
        or the camera is being moved. Raises SourceLost when the device died, DataError when what the
        source reads is malformed.
        """
        ...

    def control(self, name: str, value: ControlValue) -> str:
        """Set one of the device's controls; what was done, in words for the operator.

        Names are those of docs/control.md (`led`, `tilt_deg`, `depth`, ...). The thread that reads calls it.
        ControlRefused where the source has no such control or value, SourceLost when the device died of it.
        """
        ...

    def close(self) -> None:
        """Release the device; harmless when already closed."""
        ...

    def __enter__(self) -> Self:
        """The source itself."""
        ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
        /,
    ) -> None:
        """Close."""
        ...
