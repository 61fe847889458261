"""Section `peers`: the rig's frames through LCM, ZeroMQ and our own transport, one machine, one run.

python tests/benchmarks/transport_peers.py   (as root: it works in network namespaces of its own)
"""

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from support.key_for_tests import rig_key_file
from support.network_namespaces import Namespaces, why_unavailable
from support.preencoded_sender import Play, encoded_file, total

PEERS = {"ours": "kinect-rig", "lcm": "LCM", "zeromq": "ZeroMQ"}
PROGRAM = str(Path(__file__).resolve().parents[1] / "support" / "peer_program.py")
# Cameras and frames a second; the first is the rig. A camera's settings allow 120 frames a second.
STEPS = (
    (12, 30),
    (12, 45),
    (12, 60),
    (12, 75),
    (12, 90),
    (12, 105),
    (12, 120),
    (18, 100),
    (24, 90),
    (24, 105),
)
SECONDS, LOSS_SECONDS = 2.0, 5.0
TRIALS = 2  # a step fails when each trial loses a frame: one may meet another program's work
SATURATED = 0.9  # of the offered rate: more is not to be had
PORT = 4600
_LINK = (
    "ip addr add 10.76.0.{host}/24 dev veth",
    "ip link set veth up",
    "ip route add 224.0.0.0/4 dev veth",
)
# A cable of the kernel's carries a burst in one piece: it must be cut, or a drop would take a whole one.
_CUT = "ip link set veth gso_max_segs 1"
_DROP = """table netdev loss {
  chain arriving { type filter hook ingress device "veth" priority 0; numgen random mod 100 < 1 drop; }
}
"""


@dataclass(frozen=True)
class Route:
    """Where a sender and a receiver are."""

    namespaces: Namespaces
    sender: str
    receiver: str
    address: str


@dataclass(frozen=True)
class Trial:
    """What one play gave."""

    submitted: int
    received: int
    received_bytes: float
    seconds: float
    receiver_cpu_s: float
    sender_cpu_s: float

    @property
    def lost(self) -> float:
        """Share of the frames that did not arrive whole."""
        return 1 - self.received / self.submitted

    @property
    def mb_s(self) -> float:
        """Payload that arrived."""
        return self.received_bytes / self.seconds / 1e6


def run() -> dict[str, Any] | list[dict[str, Any]]:
    """The section `peers` of bench.json."""
    reason = why_unavailable()
    if reason is not None:
        return {"skipped": reason}
    rig_key_file()  # before the first program is started, so that all inherit it
    with encoded_file() as (file, _):
        return [measure(peer, file) for peer in PEERS]


def measure(peer: str, file: Path) -> dict[str, Any]:
    """One row. Rates and processor time over a link that loses nothing; loss where 1 % is dropped."""
    with link(dropping=False) as path:
        passed = lossless_trials(peer, path, file)
        at_rig = play(peer, path, file, *STEPS[0], LOSS_SECONDS)
    with link(dropping=True) as path:
        over_loss = play(peer, path, file, *STEPS[0], LOSS_SECONDS)
    gigabytes = at_rig.received_bytes / 1e9
    return {
        "name": PEERS[peer],
        "mb_s": max((trial.mb_s for trial in passed), default=0.0),
        "cpu_s_per_gb": at_rig.receiver_cpu_s / gigabytes,
        "sender_cpu_s_per_gb": at_rig.sender_cpu_s / gigabytes,
        "lost": over_loss.lost,
        "lost_without_drops": at_rig.lost,
    }


def lossless_trials(peer: str, path: Route, file: Path) -> list[Trial]:
    """Ever higher rates, until the first that loses a frame or that the sender does not reach."""
    passed: list[Trial] = []
    for cameras, fps in STEPS:
        trial = lossless(peer, path, file, cameras, fps)
        if trial is None:
            break
        passed.append(trial)
        if trial.received / trial.seconds < SATURATED * cameras * fps:
            break
    return passed


def lossless(peer: str, path: Route, file: Path, cameras: int, fps: float) -> Trial | None:
    """A trial of this rate that lost nothing, or None."""
    for _ in range(TRIALS):
        trial = play(peer, path, file, cameras, fps, SECONDS)
        if trial.received == trial.submitted:
            return trial
    return None


def play(peer: str, path: Route, file: Path, cameras: int, fps: float, seconds: float) -> Trial:
    """Sender and receiver as processes."""
    start = path.namespaces.start
    words = ["--peer", peer, "--address", path.address]
    receiver = start(path.receiver, [sys.executable, PROGRAM, "receive", *words], stdout=subprocess.PIPE)
    assert receiver.stdout is not None
    assert receiver.stdout.readline().strip() == "ready"
    if peer == "ours":
        command = Play(path.address, range(cameras), fps, seconds).command(file)
    else:
        load = [
            "--frames",
            str(file),
            "--cameras",
            str(cameras),
            "--fps",
            str(fps),
            "--seconds",
            str(seconds),
        ]
        command = [sys.executable, PROGRAM, "send", *words, *load]
    sent = _result(start(path.sender, command, stdout=subprocess.PIPE))
    received = _result(receiver)
    ours = peer == "ours"
    return Trial(
        submitted=total(sent, "submitted") if ours else sent["submitted"],
        received=received["frames"],
        received_bytes=received["bytes"],
        seconds=received["seconds"],
        receiver_cpu_s=received["cpu_s"],
        sender_cpu_s=sent["cores"] * seconds if ours else sent["cpu_s"],
    )


@contextmanager
def link(dropping: bool) -> Iterator[Route]:
    """Two namespaces and a cable with Ethernet's frame size; one end may lose 1 % of what arrives."""
    namespaces = Namespaces()
    try:
        for host in ("sender", "receiver"):
            namespaces.add(host)
        peer = namespaces.full_name("receiver")
        namespaces.command("sender", f"ip link add veth type veth peer name veth netns {peer}")
        for number, host in enumerate(("sender", "receiver"), start=1):
            for line in _LINK:
                namespaces.command(host, line.format(host=number))
        if dropping:
            namespaces.command("sender", _CUT)
            namespaces.command("receiver", "nft -f -", _DROP)
        yield Route(namespaces, "sender", "receiver", f"10.76.0.2:{PORT}")
    finally:
        namespaces.remove()


def _result(process: subprocess.Popen[str]) -> dict[str, Any]:
    output, _ = process.communicate(timeout=60)
    return dict(json.loads(output.splitlines()[-1]))


def main() -> None:
    """Print the section."""
    print(json.dumps(run(), indent=1))


if __name__ == "__main__":
    main()
