"""Cameras that play encoded frames through the agent's real uplink: everything of an agent but the encoder.

python tests/support/preencoded_sender.py --frames FILE --server HOST:PORT --cameras 0,1,2 --seconds 20

One process and one thread plays all its cameras. At the end it prints one line of JSON: by camera, the
frames `submitted`, and of these `sent` whole, `dropped` by the pacer and `unheard` because nobody listened.
"""

import argparse
import json
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rig_agent.config import AgentSettings
from rig_agent.hello import make_hello
from rig_agent.sources.base import ColorImage, SourceDescription
from rig_agent.transport import now_ns
from rig_agent.uplink import Uplink
from rig_protocol.camera import CameraModel
from rig_protocol.key_file import rig_key
from support.key_for_tests import rig_key_file
from support.preencoded_frames import Format, PreencodedFrames, encode_frames

Phase = Literal["free", "same"]
"""When in the frame interval each camera exposes: all at times of their own, or all at one instant."""

_GOLDEN = 0.618034  # multiples of it fill the interval evenly, however many cameras there are
_LAST_FRAME_NS = 200_000_000  # to send the last frame, and again what of it was lost
_TICK_NS = 100_000_000


@dataclass(frozen=True)
class Play:
    """What one sender process plays."""

    server: str
    cameras: Sequence[int]
    fps: float = 30.0
    seconds: float = 20.0
    phase: Phase = "free"
    paced: bool = True
    key_file: Path = field(default_factory=rig_key_file)

    def agent_settings(self, camera: int, form: Format) -> AgentSettings:
        """As `rig-agent` would have them."""
        values: dict[str, Any] = {
            "server": self.server,
            "camera": camera,
            "fps": self.fps,
            "key_file": self.key_file,
        }
        if form == "rgb24":
            values |= {"color": "raw", "depth": "raw"}
        if not self.paced:
            values["pacing"] = {"spread": 0.0, "burst": 44}
        return AgentSettings.model_validate(values)

    def command(self, frames: Path) -> list[str]:
        """The words that start a process which plays this, to be run in any network namespace."""
        return [
            *(sys.executable, str(Path(__file__).resolve()), "--frames", str(frames)),
            *("--server", self.server, "--cameras", ",".join(map(str, self.cameras))),
            *("--fps", str(self.fps), "--seconds", str(self.seconds), "--phase", self.phase),
            *([] if self.paced else ["--unpaced"]),
            *("--key-file", str(self.key_file)),
        ]


class CameraSender:
    """One camera. The first frame is due at the first exposure after `begin`."""

    def __init__(self, play: Play, camera: int, frames: PreencodedFrames) -> None:
        settings = play.agent_settings(camera, frames.form)
        color: ColorImage = "bgr" if frames.form == "rgb24" else "bayer"
        source = SourceDescription(None, None, CameraModel(), play.fps, color, "raw")
        self.camera, self._frames = camera, frames
        self._interval_ns = round(1e9 / play.fps)
        self._phase_ns = int(camera * _GOLDEN % 1 * self._interval_ns) if play.phase == "free" else 0
        self._count = round(play.seconds * play.fps)
        self._exposure_ns: int | None = None
        self.uplink = Uplink(settings, rig_key(settings.key_file, settings.insecure))
        self.uplink.introduce(make_hello(settings, source), now_ns())
        self.submitted = 0
        self.due_ns = 0

    @property
    def connected(self) -> bool:
        """Whether the server listens."""
        return self.uplink.welcome is not None

    @property
    def finished(self) -> bool:
        """Whether every frame was submitted."""
        return self.submitted == self._count

    def begin(self, time_ns: int) -> None:
        """Frames from now on, at multiples of the interval on this machine's clock, plus the phase."""
        self.due_ns = 0
        self._exposure_ns = -(-time_ns // self._interval_ns) * self._interval_ns + self._phase_ns

    def serve(self, time_ns: int) -> None:
        """Submit the frames that are due, and let the uplink work."""
        self.uplink.serve(time_ns)
        while not self.finished and self._exposure_ns is not None and self._exposure_ns <= time_ns:
            frame = self._frames.frame(self.camera, self.submitted, self._exposure_ns)
            self.uplink.send_frame(frame, time_ns)
            self.submitted += 1
            self._exposure_ns += self._interval_ns
        times_ns = [self.uplink.next_timeout_ns(), None if self.finished else self._exposure_ns]
        self.due_ns = min((t for t in times_ns if t is not None), default=time_ns + _TICK_NS)

    def counts(self) -> dict[str, int]:
        """What became of the frames."""
        uplink = self.uplink
        return {
            "submitted": self.submitted,
            "sent": uplink.sent,
            "dropped": uplink.dropped,
            "unheard": uplink.unheard,
        }


class Sender:
    """All cameras of one process."""

    def __init__(self, play: Play, frames: PreencodedFrames) -> None:
        self._senders = [CameraSender(play, camera, frames) for camera in play.cameras]
        self._stopping = False
        self.cores = 0.0  # processor time over time while playing

    def stop(self) -> None:
        """End early."""
        self._stopping = True

    def run(self) -> dict[int, dict[str, int]]:
        """Wait until the server listens to all of them, play, say goodbye; counts by camera."""
        while not self._stopping and not all(sender.connected for sender in self._senders):
            self._turn()
        begin_ns, begin_cpu_s = now_ns(), time.process_time()
        for sender in self._senders:
            sender.begin(begin_ns)
        while not self._stopping and not all(sender.finished for sender in self._senders):
            self._turn()
        until_ns = now_ns() + _LAST_FRAME_NS
        while not self._stopping and now_ns() < until_ns:
            self._turn()
        for sender in self._senders:
            sender.uplink.close(now_ns())
        self.cores = (time.process_time() - begin_cpu_s) / ((now_ns() - begin_ns) / 1e9)
        return {sender.camera: sender.counts() for sender in self._senders}

    def _turn(self) -> None:
        """Sleep until a datagram comes or something is due, and serve those whom it concerns."""
        by_descriptor = {fd: s for s in self._senders if (fd := s.uplink.fileno()) is not None}
        due_ns = min(sender.due_ns for sender in self._senders)
        timeout_s = min(max(due_ns - now_ns(), 0), _TICK_NS) / 1e9
        ready = select.select(list(by_descriptor), [], [], timeout_s)[0]
        heard = {id(by_descriptor[descriptor]) for descriptor in ready}
        time_ns = now_ns()
        for sender in self._senders:
            if sender.due_ns <= time_ns or id(sender) in heard:
                sender.serve(time_ns)


@dataclass
class SenderProcess:
    """A running sender."""

    process: subprocess.Popen[str]

    def result(self, timeout_s: float = 120.0) -> dict[str, Any]:
        """What it printed at its end."""
        output, _ = self.process.communicate(timeout=timeout_s)
        assert self.process.returncode == 0, f"the sender ended with {self.process.returncode}"
        return dict(json.loads(output.splitlines()[-1]))


@contextmanager
def sender_process(play: Play, frames: Path, prefix: Sequence[str] = ()) -> Iterator[SenderProcess]:
    """A process that plays; `prefix` runs it elsewhere: ip netns exec NAME. Ended with the block."""
    with subprocess.Popen([*prefix, *play.command(frames)], stdout=subprocess.PIPE, text=True) as process:
        try:
            yield SenderProcess(process)
        finally:
            process.terminate()
            if process.stdout is not None and not process.stdout.closed:
                process.stdout.read()  # nobody asked for the result: let it be printed all the same


@contextmanager
def encoded_file(form: Format = "lossless") -> Iterator[tuple[Path, PreencodedFrames]]:
    """Frames encoded now, and the file that holds them, for as long as the block lasts."""
    with tempfile.TemporaryDirectory() as folder:
        frames, file = encode_frames(form), Path(folder) / "frames.npz"
        frames.save(file)
        yield file, frames


def total(result: Mapping[str, Any], name: str) -> int:
    """A count of all cameras of a result."""
    return sum(counts[name] for counts in result["cameras"].values())


def _parse() -> tuple[Play, argparse.Namespace]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--frames", type=Path, help="file of encoded frames; unset: encode some now")
    parser.add_argument("--format", choices=["lossless", "rgb24"], default="lossless", help="what to encode")
    parser.add_argument("--server", default="127.0.0.1:4012")
    parser.add_argument("--cameras", default=",".join(map(str, range(12))))
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--phase", choices=["free", "same"], default="free")
    parser.add_argument("--unpaced", action="store_true", help="send every frame at once")
    parser.add_argument("--key-file", type=Path, required=True, help="the rig's key")
    known = parser.parse_args()
    cameras = [int(word) for word in known.cameras.split(",")]
    play = Play(
        known.server, cameras, known.fps, known.seconds, known.phase, not known.unpaced, known.key_file
    )
    return play, known


def main() -> None:
    """Play, and print what became of the frames."""
    play, known = _parse()
    frames = PreencodedFrames.load(known.frames) if known.frames else encode_frames(known.format)
    sender = Sender(play, frames)
    signal.signal(signal.SIGTERM, lambda *_: sender.stop())
    cameras = sender.run()
    facts = {"frame_bytes": frames.frame_bytes, "real": frames.real, "cores": sender.cores}
    print(json.dumps({"cameras": cameras, **facts}), flush=True)


if __name__ == "__main__":
    main()
