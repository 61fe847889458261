"""One virtual Kinect of the simulated ring, free-running on the monotonic clock as a real one does."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import TracebackType
from typing import Self

from rig_agent.simulator.ring import VirtualRig
from rig_agent.simulator.settings import SimulatorSettings
from rig_agent.sources.base import ControlRefused, ControlValue, SourceDescription
from rig_protocol.frames import RgbdFrame


class SyntheticSource:
    """A FrameSource that renders one camera of the ring and gives every frame fresh noise.

    Frame 0 is the first one due after opening; the phase on the clock is the unit's own.
    ConfigurationError when the ring has no such camera. Truth never leaves through this interface:
    who wants it asks `simulator.ring.true_poses`.
    """

    def __init__(
        self,
        settings: SimulatorSettings,
        camera: int,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Render the camera's view, about half a second of work, and start its frames."""
        self._kinect = VirtualRig(settings).camera(camera)
        self._fps = settings.fps
        self._clock, self._sleep = clock, sleep
        self._counters = {"skipped": 0}
        self._has_depth = self._kinect.frame(0).raw is not None
        interval_ns, phase_ns = self._kinect.frame_interval_ns, self._kinect.phase_ns
        self._start_ns = phase_ns + ((clock() - phase_ns) // interval_ns + 1) * interval_ns
        self._interval_ns = interval_ns
        self._next = 0

    @property
    def counters(self) -> Mapping[str, int]:
        """`skipped`: frames that were due while nobody read."""
        return self._counters

    def describe(self) -> SourceDescription:
        """The virtual unit, with what its factory says of it."""
        return SourceDescription(
            serial=self._kinect.serial,
            port_path=None,
            model=self._kinect.model,
            fps=self._fps,
            color_image="bayer",
            depth_image="raw" if self._has_depth else None,
            camera_id=self._kinect.id,
        )

    def read(self, timeout_s: float) -> RgbdFrame | None:
        """The frame that is due next, stamped with the instant it was taken."""
        now_ns = self._clock()
        behind = (now_ns - self._start_ns) // self._interval_ns - self._next
        if behind > 0:
            self._counters["skipped"] += behind
            self._next += behind
        taken_ns = self._start_ns + self._next * self._interval_ns
        wait_s = (taken_ns - now_ns) / 1e9
        if wait_s > timeout_s:
            self._sleep(timeout_s)
            return None
        if wait_s > 0:
            self._sleep(wait_s)
        number, self._next = self._next, self._next + 1
        return replace(self._kinect.frame(number), timestamp_ns=taken_ns)

    def control(self, name: str, value: ControlValue) -> str:
        """There is nothing to set: ControlRefused."""
        raise ControlRefused(f"the simulator cannot set {name} to {value}")

    def close(self) -> None:
        """Nothing to release."""

    def __enter__(self) -> Self:
        """The source itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        """Close."""
        self.close()
