"""A camera of small numbered frames for tests of the agent, and the agent on a thread."""

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import TracebackType
from typing import Self

import numpy as np

from rig_agent.agent import Agent
from rig_agent.config import AgentSettings
from rig_agent.sources.base import ControlRefused, ControlValue, FrameSource, SourceDescription, SourceLost
from rig_protocol.camera import CameraModel
from rig_protocol.frames import RgbdFrame
from rig_protocol.rig_key import RigKey

FPS = 100.0


class SmallSource:
    """A FrameSource of small frames, each filled with its number, as fast as `fps` says."""

    def __init__(
        self, serial: str = "A1", fps: float = FPS, trouble: Callable[[], None] = lambda: None
    ) -> None:
        self._serial, self._fps, self._trouble = serial, fps, trouble
        self._number = 0
        self.counters: Mapping[str, int] = {}
        self.closed = False
        self.done: list[tuple[str, ControlValue]] = []

    def describe(self) -> SourceDescription:
        return SourceDescription(self._serial, None, CameraModel(), FPS, "bayer", "raw")

    def read(self, timeout_s: float) -> RgbdFrame | None:
        self._trouble()
        time.sleep(min(1 / self._fps, timeout_s))
        number, self._number = self._number, self._number + 1
        return make_frame(number)

    def control(self, name: str, value: ControlValue) -> str:
        if name == "die":
            raise SourceLost("the device died of it")
        if name == "sing":
            raise ControlRefused("there is no control sing: it has tilt_deg")
        self.done.append((name, value))
        return f"{name} is {value}"

    def close(self) -> None:
        self.closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self.close()


def make_frame(number: int) -> RgbdFrame:
    bayer = np.full((48, 64), number % 256, np.uint8)
    raw = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64) % 2048
    return RgbdFrame(0, number, time.monotonic_ns(), bayer=bayer, raw=raw)


@contextmanager
def running(
    settings: AgentSettings,
    open_source: Callable[[], FrameSource],
    key: RigKey | None = RigKey.INSECURE,
) -> Iterator[Agent]:
    """An agent whose `run` is on a thread; stopped at the end."""
    agent = Agent(settings, key, open_source)
    thread = threading.Thread(target=agent.run)
    thread.start()
    try:
        yield agent
    finally:
        agent.stop()
        thread.join(20)
        assert not thread.is_alive()


def await_true(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)
