"""A real server in a process of its own that takes sets as a user's program would, and measures itself.

python tests/support/measured_server.py --cameras 12 --seconds 20

Prints `listening PORT`, and at the end one line of JSON: a `Measurement`.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rig_protocol.frames import PanoramicFrame
from rig_server import Rig
from rig_server.config import CameraSettings, RigSettings
from rig_server.receiver import rig_time_ns
from support import process_meter
from support.key_for_tests import rig_key_file
from support.process_meter import Cost

WARM_UP_S = 8.0  # until buffers and the pool of freed images have their size
_PATIENCE_S = 30.0


@dataclass(frozen=True)
class Measurement:
    """A window of the stream. Expected are the sets that the cameras exposed in it."""

    expected_sets: int
    complete_sets: int
    partial_sets: int
    seconds: float
    latency_ms: list[float]
    """Last datagram of a complete set's last frame here → set taken: percentiles 50, 90, 99, 100."""
    cost: Cost
    rss_mb: list[tuple[float, float]]
    """Seconds since the window began, and resident memory."""
    dropped: Mapping[str, int]
    lost_frames: int
    authenticated: bool

    @classmethod
    def of(cls, values: dict[str, Any]) -> "Measurement":
        """What `asdict` made."""
        return cls(**(values | {"cost": Cost(**values["cost"])}))


@dataclass
class _Window:
    """Sets of exposure times [first, first + count) periods."""

    first_ns: int
    count: int
    period_ns: int
    complete: int = 0
    partial: int = 0
    latencies_ms: list[float] = field(default_factory=list)
    rss_mb: list[tuple[float, float]] = field(default_factory=list)

    def is_over(self, panorama: PanoramicFrame) -> bool:
        """Whether this set, half a period of tolerance given, comes after the window."""
        return panorama.timestamp_ns > self.first_ns + (self.count - 0.5) * self.period_ns

    def take(self, panorama: PanoramicFrame, now_ns: int) -> None:
        """Count a set that was taken at `now_ns`."""
        if not panorama.complete:
            self.partial += 1
            return
        self.complete += 1
        arrivals_ns = [frame.received_ns or 0 for frame in panorama.frames.values() if frame is not None]
        self.latencies_ms.append((now_ns - max(arrivals_ns)) / 1e6)


def measure(rig: Rig, fps: float, seconds: float) -> Measurement:
    """Let the stream settle, then count and time its sets until the window is over."""
    first = _settled_set(rig, WARM_UP_S)
    before = process_meter.read()
    window = _Window(first.timestamp_ns, round(seconds * fps), round(1e9 / fps))
    window.take(first, rig_time_ns())
    until_s, sample_s = before.wall_s + seconds + 2.0, before.wall_s
    while time.monotonic() < until_s:
        panorama = rig.next_panorama(0.1)
        now_ns = rig_time_ns()
        if panorama is not None and window.is_over(panorama):
            break
        if panorama is not None:
            window.take(panorama, now_ns)
        if now_ns / 1e9 >= sample_s:
            window.rss_mb.append((now_ns / 1e9 - before.wall_s, process_meter.resident_mb()))
            sample_s += 0.5
    return _measurement(window, rig, before, process_meter.read())


def _settled_set(rig: Rig, warm_up_s: float) -> PanoramicFrame:
    """The first complete set after the stream has run for a while."""
    until_s, begin_s = time.monotonic() + _PATIENCE_S, None
    while time.monotonic() < until_s:
        panorama = rig.next_panorama(0.5)
        if panorama is None:
            continue
        begin_s = begin_s or time.monotonic()
        if panorama.complete and time.monotonic() - begin_s >= warm_up_s:
            return panorama
    raise SystemExit(f"no complete set within {_PATIENCE_S:.0f} s: {rig.status()}")


def _measurement(
    window: _Window, rig: Rig, before: process_meter.Reading, after: process_meter.Reading
) -> Measurement:
    status = rig.status()
    return Measurement(
        expected_sets=window.count,
        complete_sets=window.complete,
        partial_sets=window.partial,
        seconds=after.wall_s - before.wall_s,
        latency_ms=[float(value) for value in np.percentile(window.latencies_ms, [50, 90, 99, 100])],
        cost=process_meter.cost(before, after),
        rss_mb=window.rss_mb,
        dropped=status.dropped,
        lost_frames=sum(camera.lost for camera in status.cameras),
        authenticated=status.authenticated,
    )


@dataclass
class MeasuredServer:
    """A running one."""

    process: subprocess.Popen[str]
    port: int

    def result(self, timeout_s: float = 180.0) -> Measurement:
        """What it measured."""
        output, _ = self.process.communicate(timeout=timeout_s)
        assert self.process.returncode == 0, f"the server ended with {self.process.returncode}"
        return Measurement.of(json.loads(output.splitlines()[-1]))


@contextmanager
def measured_server(
    cameras: int,
    seconds: float,
    fps: float = 30.0,
    settings: Mapping[str, object] | None = None,
    listen: str = "127.0.0.1:0",
    prefix: Sequence[str] = (),
    environment: Mapping[str, str] | None = None,
) -> Iterator[MeasuredServer]:
    """A server process that listens; `prefix` runs it elsewhere: ip netns exec NAME. Ended with the block."""
    words = [
        *(*prefix, sys.executable, str(Path(__file__).resolve()), "--listen", listen),
        *("--cameras", str(cameras), "--seconds", str(seconds), "--fps", str(fps)),
        *("--settings", json.dumps({"key_file": str(rig_key_file())} | dict(settings or {}))),
    ]
    env = {**os.environ, **(environment or {})}
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=env) as process:
        try:
            assert process.stdout is not None
            said = process.stdout.readline().split()
            assert said[:1] == ["listening"], f"the server said {said}"
            yield MeasuredServer(process, int(said[1]))
        finally:
            process.terminate()


def main() -> None:
    """Serve, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--listen", default="127.0.0.1:0")
    parser.add_argument("--cameras", type=int, default=12)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--settings", type=json.loads, default={}, help="JSON of further server settings")
    known = parser.parse_args()
    listed = tuple(CameraSettings(id=i) for i in range(known.cameras))
    settings = RigSettings.model_validate({"listen": known.listen, "cameras": listed, **known.settings})
    with Rig.live(settings) as rig:
        print("listening", rig.place.rsplit(":", 1)[1], flush=True)
        print(json.dumps(asdict(measure(rig, known.fps, known.seconds))), flush=True)


if __name__ == "__main__":
    main()
