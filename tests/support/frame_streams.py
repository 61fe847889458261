"""Frames of free-running cameras in virtual time, and what a synchroniser makes of them."""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from rig_protocol.camera_queue import MAX_PENDING
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.synchroniser import Policy, Synchroniser

MS = 1_000_000
S = 1000 * MS
PERIOD_NS = 33_333_333
DEADLINE_NS = 100 * MS
LATENCY_NS = 40 * MS

Arrival = tuple[int, RgbdFrame]
"""When a frame comes, and the frame."""

Happening = tuple[int, Callable[[Synchroniser], None]]
"""When something else happens, and what."""


class Delivery(NamedTuple):
    """A set that went out, and when."""

    now_ns: int
    panorama: PanoramicFrame

    @property
    def frames(self) -> list[RgbdFrame]:
        """The frames that are not missing."""
        return [frame for frame in self.panorama.frames.values() if frame is not None]


def frame(camera_id: int, timestamp_ns: int, sequence: int = 0) -> RgbdFrame:
    """A frame without images."""
    return RgbdFrame(camera_id=camera_id, sequence=sequence, timestamp_ns=timestamp_ns)


def joined(
    cameras: Iterable[int],
    fps: float = 30.0,
    policy: Policy = "partial",
    max_spread_ns: int | None = None,
    deadline_ns: int = DEADLINE_NS,
) -> Synchroniser:
    """A synchroniser with these cameras, expected and connected."""
    cameras = list(cameras)
    synchroniser = Synchroniser(cameras, deadline_ns, max_spread_ns, policy=policy)
    for camera_id in cameras:
        synchroniser.camera_joined(camera_id, fps)
    return synchroniser


def stream(
    camera_id: int, phase_ns: int, count: int, period_ns: int = PERIOD_NS, latency_ns: int = LATENCY_NS
) -> list[Arrival]:
    """The frames of a camera without jitter or loss."""
    times = [phase_ns + k * period_ns for k in range(count)]
    return [(time + latency_ns, frame(camera_id, time, k)) for k, time in enumerate(times)]


def free_running(
    rng: np.random.Generator,
    camera_id: int,
    seconds: float,
    fps: float = 30.0,
    *,
    start_ns: int = 0,
    drift_ppm: float = 100.0,
    jitter_ns: int = MS,
    loss: float = 0.0,
) -> list[Arrival]:
    """A camera at a phase and with a drift of its own, jitter of its stamps, and frames lost at random."""
    period_ns = 1e9 / fps * (1 + rng.uniform(-drift_ppm, drift_ppm) * 1e-6)
    count = int(seconds * fps)
    times = start_ns + rng.uniform(0, period_ns) + period_ns * np.arange(count)
    times += rng.uniform(-jitter_ns, jitter_ns, count)
    arrivals = times + LATENCY_NS + rng.uniform(0, 5 * MS, count)
    kept = np.flatnonzero(rng.random(count) >= loss).tolist()
    return [(int(arrivals[k]), frame(camera_id, int(times[k]), k)) for k in kept]


def run(
    synchroniser: Synchroniser,
    arrivals: Iterable[Arrival],
    happenings: Sequence[Happening] = (),
    until_ns: int = 10**18,
) -> list[Delivery]:
    """Feed everything in the order of time, fire time-outs in between; the sets that went out.

    Checks at every step that no frame waits beyond its time and that the queues are bounded.
    """
    delivered: list[Delivery] = []

    def drain(now_ns: int) -> None:
        while (panorama := synchroniser.next_panorama(now_ns)) is not None:
            delivered.append(Delivery(now_ns, panorama))
        due_ns = synchroniser.next_timeout_ns()
        assert due_ns is None or due_ns > now_ns
        assert (due_ns is None) == (synchroniser.waiting == 0)
        assert synchroniser.waiting <= MAX_PENDING * len(cameras)

    def fire_timeouts(before_ns: int) -> None:
        while (due_ns := synchroniser.next_timeout_ns()) is not None and due_ns <= before_ns:
            drain(due_ns)

    feed = [(now_ns, _adding(item, now_ns)) for now_ns, item in arrivals]
    cameras = {item.camera_id for _, item in arrivals}
    for now_ns, act in sorted([*feed, *happenings], key=lambda pair: pair[0]):
        fire_timeouts(now_ns)
        act(synchroniser)
        drain(now_ns)
    fire_timeouts(until_ns)
    return delivered


def check_sets(delivered: Sequence[Delivery], *, repeats: bool = False) -> list[tuple[int, int]]:
    """Check what holds for all sets of a run; camera and sequence of every frame used, once each."""
    last_ns: dict[int, int] = {}
    used = []
    for index, (_, panorama) in enumerate(delivered):
        assert panorama.index == index
        assert index == 0 or panorama.timestamp_ns > delivered[index - 1].panorama.timestamp_ns
        for camera_id, item in panorama.frames.items():
            if item is None or (repeats and last_ns.get(camera_id) == item.timestamp_ns):
                continue
            assert item.camera_id == camera_id
            assert item.timestamp_ns > last_ns.get(camera_id, -(2**63))
            last_ns[camera_id] = item.timestamp_ns
            used.append((camera_id, item.sequence))
    assert len(used) == len(set(used))
    return used


def _adding(item: RgbdFrame, now_ns: int) -> Callable[[Synchroniser], None]:
    return lambda synchroniser: synchroniser.add(item, now_ns)
