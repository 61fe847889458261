"""A take recorded from agents in threads of the test, and the comparison of sets bit for bit."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_server import Rig
from rig_server.config import RigSettings, SynchroniserSettings
from support.small_agent import SmallAgent

SETTINGS = RigSettings(
    listen="127.0.0.1:0",
    insecure=True,
    expected_cameras=2,
    synchroniser=SynchroniserSettings(deadline_ms=500),
)


def record_take(path: Path, sets: int = 20) -> list[PanoramicFrame]:
    """Record two cameras at 50 frames a second; the sets that the live rig gave."""
    with Rig.live(SETTINGS, record=path) as rig:
        host, port = rig.place.removeprefix("UDP ").split(":")
        with SmallAgent(0, (host, int(port))), SmallAgent(1, (host, int(port))):
            rig.wait_for_cameras(30)
            return [one for _, one in zip(range(sets), rig, strict=False)]


def same_set(one: PanoramicFrame, other: PanoramicFrame) -> bool:
    """Everything of a set and its frames, but for its index."""
    times = [(p.timestamp_ns, p.spread_ns, p.uncertainty_ns, list(p.frames)) for p in (one, other)]
    return times[0] == times[1] and all(same_frame(one.frames[i], other.frames[i]) for i in one.frames)


def same_images(one: PanoramicFrame, other: PanoramicFrame) -> bool:
    """Everything of a set's frames, but for their times."""
    return all(same_frame(_untimed(one.frames[i]), _untimed(other.frames[i])) for i in one.frames)


def same_frame(one: RgbdFrame | None, other: RgbdFrame | None) -> bool:
    """Every field, images bit for bit."""
    if one is None or other is None:
        return one is other
    return all(
        np.array_equal(value, getattr(other, name))
        if isinstance(value := getattr(one, name), np.ndarray)
        else value == getattr(other, name)
        for name in RgbdFrame.__slots__
    )


def _untimed(frame: RgbdFrame | None) -> RgbdFrame | None:
    return frame and replace(frame, timestamp_ns=0, received_ns=None)
