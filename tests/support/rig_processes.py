"""Real agents and servers as processes, real sockets on loopback, and waiting for what they do."""

import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from rig_protocol.camera import CameraModel
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.rig_folder import CameraEntry, RigDescription, RingDrawing, write_rig_folder
from rig_server import Rig
from rig_server.config import CameraSettings, RigSettings
from support.key_for_tests import rig_key_file

LOOPBACK = "127.0.0.1"
START_TIMEOUT_S = 60.0  # a dozen interpreters start at once on two busy cores
_STOP_TIMEOUT_S = 10.0
_STEPPING_CLOCK = Path(__file__).with_name("stepping_clock.py")


def free_port() -> int:
    """A UDP port of loopback that nobody uses now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def server_settings(port: int, cameras: int, **changes: object) -> RigSettings:
    """A server on loopback that expects so many cameras."""
    listed = tuple(CameraSettings(id=i) for i in range(cameras))
    options = {"listen": f"{LOOPBACK}:{port}", "cameras": listed, "key_file": rig_key_file()}
    return RigSettings.model_validate(options | changes)


class AgentProcess:
    """One `rig-agent`, restartable; everything it prints goes to its log."""

    def __init__(
        self,
        log: Path,
        port: int,
        options: Sequence[object],
        env: Mapping[str, str] | None = None,
        *,
        host: str = LOOPBACK,
        prefix: Sequence[str] = (),
        program: Sequence[str] = (sys.executable, "-m", "rig_agent.cli"),
        stepping: bool = False,
    ) -> None:
        """`host` is the server's; `prefix` runs the agent elsewhere: ip netns exec NAME.

        `stepping`: SIGUSR1 and SIGUSR2 make its clock jump (support/stepping_clock.py).
        """
        self._log, self._env = log, env
        if stepping:
            program = [sys.executable, str(_STEPPING_CLOCK), "rig_agent.cli"]
        self._words = [
            *(*prefix, *program, "--server", f"{host}:{port}"),
            *("--key-file", str(rig_key_file())),
            *map(str, options),
        ]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> "AgentProcess":
        """Start it."""
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                self._words, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=self._env
            )
        return self

    def kill(self) -> None:
        """As when the power fails."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def send_signal(self, number: int) -> None:
        """Any signal."""
        assert self._process is not None
        self._process.send_signal(number)

    def stop(self) -> int:
        """As systemd does; the exit status."""
        assert self._process is not None
        self._process.send_signal(signal.SIGTERM)
        try:
            return self._process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self.kill()
            raise

    def wait(self, timeout_s: float | None = START_TIMEOUT_S) -> int:
        """Until it ends by itself, None: however long that takes; the exit status."""
        assert self._process is not None
        return self._process.wait(timeout_s)

    @property
    def log(self) -> str:
        """What it printed so far."""
        return self._log.read_text()

    def wait_for_log(self, pattern: str, timeout_s: float = START_TIMEOUT_S) -> str:
        """The first match in its log; AssertionError when it ended or did not say it in time."""
        until_s = time.monotonic() + timeout_s
        while (match := re.search(pattern, self.log)) is None:
            assert self._process is not None
            assert self._process.poll() is None, f"the agent ended:\n{self.log}"
            assert time.monotonic() < until_s, f"{pattern!r} is not in the log:\n{self.log}"
            time.sleep(0.05)
        return match.group(0)


@contextmanager
def folder_agents(
    folder: Path,
    logs: Path,
    port: int,
    cameras: Sequence[int],
    fps: float = 10.0,
    *,
    host: str = LOOPBACK,
    prefix: Callable[[int], Sequence[str]] = lambda _camera: (),
) -> Iterator[dict[int, AgentProcess]]:
    """Agents that each play one camera of a rig folder; stopped at the end, whatever happened."""
    agents = {
        camera: AgentProcess(
            logs / f"agent{camera:02d}.log",
            port,
            ["--source", "folder", "--path", folder, "--camera", camera, "--fps", fps],
            host=host,
            prefix=prefix(camera),
        )
        for camera in cameras
    }
    try:
        for agent in agents.values():
            agent.start()
        yield agents
    finally:
        for agent in agents.values():
            agent.kill()


def write_small_rig(
    folder: Path, cameras: int = 12, frames: int = 2, shape: tuple[int, int] = (120, 160)
) -> list[RgbdFrame]:
    """A rig folder of small random images, every one different; the frames that it holds."""
    rng = np.random.default_rng(cameras)
    ring = RingDrawing()
    entries = [CameraEntry(i, f"cam{i:02d}", CameraModel(), ring.T_rig_camera(i)) for i in range(cameras)]
    written = [
        RgbdFrame(
            camera_id=camera,
            sequence=index,
            timestamp_ns=0,
            color=rng.integers(0, 256, (*shape, 3), dtype=np.uint8),
            raw=rng.integers(0, 2048, shape, dtype=np.uint16),
        )
        for camera in range(cameras)
        for index in range(frames)
    ]
    write_rig_folder(folder, RigDescription(tuple(entries), ring), written)
    return written


def wait_for_set(
    rig: Rig, condition: Callable[[PanoramicFrame], bool], timeout_s: float = START_TIMEOUT_S
) -> PanoramicFrame:
    """The first panoramic frame that fulfils the condition; AssertionError when none does in time."""
    until_s = time.monotonic() + timeout_s
    last: PanoramicFrame | None = None
    while time.monotonic() < until_s:
        panorama = rig.next_panorama(0.5)
        if panorama is not None and condition(panorama):
            return panorama
        last = panorama or last
    missing = "no set at all" if last is None else f"the last one lacks {last.missing}"
    raise AssertionError(f"no such set within {timeout_s:.0f} s; {missing}; {rig.status()}")


def any_set(panorama: PanoramicFrame) -> bool:  # noqa: ARG001  # a condition for wait_for_set
    """Whatever comes."""
    return True


def is_complete(panorama: PanoramicFrame) -> bool:
    """Every camera delivered."""
    return panorama.complete


def holds_only_written_images(panorama: PanoramicFrame, written: Sequence[RgbdFrame]) -> bool:
    """True when each frame is, bit for bit, one that was written for its camera."""
    return all(
        any(
            original.camera_id == camera
            and np.array_equal(original.color, frame.color)
            and np.array_equal(original.raw, frame.raw)
            for original in written
        )
        for camera, frame in panorama.frames.items()
        if frame is not None
    )


def run_program(module: str, *options: object, timeout_s: float = 150.0) -> subprocess.CompletedProcess[str]:
    """Run `rig-server` or `rig-calib` to its end, by module."""
    return subprocess.run(
        [sys.executable, "-m", module, *map(str, options)],
        capture_output=True,
        text=True,
        check=False,
        timeout=timeout_s,
    )
