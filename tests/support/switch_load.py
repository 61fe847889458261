"""A load on the emulated network: twelve hosts that play encoded frames, a real server that takes the sets.

Each host runs the agent's real uplink in a process of its own. The server checks and reassembles every
frame but does not decode it: the network is what is judged, and two cores are few for all machines at once.
Hosts and PC run with real-time priority where the kernel grants it, because other programs are no part of
the network: a host that they held up would catch up in a burst that no twelve machines would send together.
"""

import json
import os
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from rig_protocol.frames import EncodedFrame, RgbdFrame
from rig_server import Rig
from support import process_meter
from support.preencoded_sender import Phase, Play
from support.process_meter import Cost
from support.rig_processes import server_settings
from support.virtual_network import PC, PC_ADDRESS, PortCounters, VirtualNetwork, host_name

_PORT = 4012
_NO_IMAGE = np.zeros((1, 1), np.uint8)
_SERVER_TOO_SLOW = ("datagrams by the kernel", "frames not decoded in time", "sets not taken")
_OTHERS_CORES = 0.25
# Hosts before the PC: a late host disturbs the network, a late PC has its receive buffer.
_HOST_PRIORITY, _PC_PRIORITY = 2, 1
_SETTLED_S = 0.5  # from the last welcome to frames of all cameras


@dataclass(frozen=True)
class Load:
    """What the hosts send, and through what."""

    fps: float
    seconds: float
    phase: Phase = "free"
    paced: bool = True
    cameras: int = 12
    link_mbit: int = 1000
    buffer_kib: int = 128

    def slower(self, factor: int) -> "Load":
        """The same in slow motion: all rates divided, so that this machine is faster beside the network."""
        return replace(self, fps=self.fps / factor, link_mbit=self.link_mbit // factor)


@dataclass(frozen=True)
class Outcome:
    """What came of a load. Sets are those exposed while all cameras played."""

    load: Load
    complete_sets: int
    lost_sets: int
    """Sets that lack a frame, or came not at all."""
    frames: int
    lost_frames: int
    """Sent, but not here whole."""
    resent: int
    """Datagrams that came on request, because they had been lost."""
    port: PortCounters
    port_load: float
    """Share of its time that the port was sending."""
    sender_dropped: int
    """Frames that the pacers gave up, because their host or this machine was too slow."""
    sender_cores: float
    server_cores: float
    others_cores: float
    """What everything else on this machine took meanwhile; a part of it is the network's own work."""
    real_time: bool
    """Whether hosts and PC had priority over the others."""
    dropped: Mapping[str, int]
    """What the server itself lost, by cause."""

    @property
    def disturbed(self) -> bool:
        """Whether this machine was too slow or too busy for its roles: the network was not the judge."""
        last_frames = self.load.cameras  # the end may cut the last frame of each
        too_slow = self.sender_dropped > last_frames or any(map(self.dropped.get, _SERVER_TOO_SLOW))
        return too_slow or (not self.real_time and self.others_cores > _OTHERS_CORES)

    @property
    def delivered_fps(self) -> float:
        """Frames a second and camera that arrived whole."""
        return self.load.fps * self.frames / max(self.frames + self.lost_frames, 1)


def run_load(load: Load, frames: Path) -> Outcome:
    """Build the network, run the load through it, remove it."""
    link = {"speed_mbit": load.link_mbit, "switch_buffer_kib": load.buffer_kib, "usable": 1.0}
    settings = server_settings(_PORT, load.cameras, listen=f"{PC_ADDRESS}:{_PORT}", link=link)
    with (
        VirtualNetwork(load.cameras, load.link_mbit, load.buffer_kib) as network,
        _without_decoding(),
        _usual_priority_afterwards(),
    ):
        with network.inside(PC):
            rig = Rig.live(settings)
        with rig, _senders(network, load, frames) as senders:
            window = _watch(rig, network, load, senders)
            results = [_result(sender) for sender in senders]
            sender_cores = sum(r["cores"] for r in results)
            return Outcome(
                load=load,
                complete_sets=window.tally.complete,
                lost_sets=window.tally.lost,
                frames=window.frames,
                lost_frames=window.lost_frames,
                resent=window.resent,
                port=window.port,
                port_load=window.port.wire_bytes / window.seconds / (load.link_mbit * 1e6 / 8),
                sender_dropped=sum(counts["dropped"] for r in results for counts in r["cameras"].values()),
                sender_cores=sender_cores,
                server_cores=window.cost.cores,
                others_cores=window.cost.machine_cores - window.cost.cores - sender_cores,
                real_time=window.real_time,
                dropped=window.dropped,
            )


class SetTally:
    """Which of the sets that cameras exposed every `period_s` in [begin, end) were delivered complete."""

    def __init__(self, period_s: float, begin_s: float, end_s: float, complete_s: Sequence[float]) -> None:
        """`complete_s` are the exposure times of delivered complete sets, these and others."""
        assert begin_s < end_s, "the cameras never played all at once"
        self._period_s = period_s
        inside_s = sorted(time_s for time_s in complete_s if begin_s <= time_s < end_s)
        self._times_s = [begin_s, *inside_s, end_s]

    @property
    def complete(self) -> int:
        """Sets with a frame of every camera."""
        return len(self._times_s) - 2

    @property
    def lost(self) -> int:
        """Sets that fit into the gaps between complete ones."""
        gaps = [(later - earlier) / self._period_s for earlier, later in pairwise(self._times_s)]
        if len(gaps) == 1:
            return int(gaps[0])
        return int(gaps[0]) + sum(max(0, round(gap) - 1) for gap in gaps[1:-1]) + int(gaps[-1])


@dataclass(frozen=True)
class _Window:
    """The time while all cameras played."""

    tally: SetTally
    frames: int
    lost_frames: int
    resent: int
    port: PortCounters
    seconds: float
    cost: Cost
    real_time: bool
    dropped: Mapping[str, int]


def _watch(
    rig: Rig, network: VirtualNetwork, load: Load, senders: Sequence["subprocess.Popen[str]"]
) -> _Window:
    """Take sets until all senders have ended; those that count were exposed while all of them played."""
    complete_s: list[float] = []

    def take_while(going_on: Callable[[], bool]) -> None:
        while going_on():
            panorama = rig.next_panorama(0.05)
            if panorama is not None and panorama.complete:
                complete_s.append(panorama.timestamp_ns / 1e9)

    def connected() -> int:
        assert all(sender.poll() is None for sender in senders), "a sender ended before all had begun"
        return rig.status().connected

    margin_s = _SETTLED_S + 2 / load.fps
    take_while(lambda: connected() == 0)
    end_s = time.monotonic() + load.seconds - margin_s  # the first to begin ends first
    take_while(lambda: connected() < load.cameras)
    real_time = _prefer(senders)  # now that all programs are loaded, which may take its time
    begin_s = time.monotonic() + margin_s
    take_while(lambda: time.monotonic() < begin_s)
    before, port_before, rig_before = process_meter.read(), network.port(), rig.status()
    take_while(lambda: time.monotonic() < end_s)
    after, port_after, rig_after = process_meter.read(), network.port(), rig.status()
    take_while(lambda: any(sender.poll() is None for sender in senders))
    return _Window(
        tally=SetTally(1 / load.fps, begin_s, end_s, complete_s),
        frames=sum(camera.frames for camera in rig_after.cameras)
        - sum(camera.frames for camera in rig_before.cameras),
        lost_frames=sum(camera.lost for camera in rig_after.cameras)
        - sum(camera.lost for camera in rig_before.cameras),
        resent=sum(camera.resent for camera in rig_after.cameras)
        - sum(camera.resent for camera in rig_before.cameras),
        port=port_after.since(port_before),
        seconds=after.wall_s - before.wall_s,
        cost=process_meter.cost(before, after),
        real_time=real_time,
        dropped={cause: count - rig_before.dropped[cause] for cause, count in rig_after.dropped.items()},
    )


def _prefer(senders: Sequence["subprocess.Popen[str]"]) -> bool:
    """Real-time priority for the hosts and for every thread of this process; False where it is refused."""
    threads = [int(task.name) for task in Path("/proc/self/task").iterdir()]
    try:
        for process_id, priority in (
            *((sender.pid, _HOST_PRIORITY) for sender in senders),
            *((thread, _PC_PRIORITY) for thread in threads),
        ):
            os.sched_setscheduler(process_id, os.SCHED_RR, os.sched_param(priority))
    except PermissionError:
        return False
    return True


@contextmanager
def _usual_priority_afterwards() -> Iterator[None]:
    """For the calling thread, which outlives the others."""
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextmanager
def _senders(network: VirtualNetwork, load: Load, frames: Path) -> Iterator[list["subprocess.Popen[str]"]]:
    """One process on each host."""
    plays = [
        Play(f"{PC_ADDRESS}:{_PORT}", [i], load.fps, load.seconds, load.phase, load.paced)
        for i in range(load.cameras)
    ]
    yield [
        network.run_in(host_name(i), play.command(frames), stdout=subprocess.PIPE)
        for i, play in enumerate(plays)
    ]


def _result(sender: "subprocess.Popen[str]") -> dict[str, Any]:
    printed, _ = sender.communicate(timeout=30)
    assert sender.returncode == 0, f"a sender ended with {sender.returncode}"
    return dict(json.loads(printed.splitlines()[-1]))


def _without_decoding() -> "mock._patch[Any]":
    """Frames become sets with a placeholder for their images."""
    return mock.patch("rig_server.decoder.decode_frame", _undecoded)


def _undecoded(frame: EncodedFrame, demosaic: bool = False) -> RgbdFrame:  # noqa: ARG001
    return RgbdFrame(
        frame.camera_id, frame.sequence, frame.timestamp_ns, bayer=_NO_IMAGE, received_ns=frame.received_ns
    )
