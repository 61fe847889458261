"""What capturing a Kinect costs, apart from encoding, and whether a torn frame ever passes as whole.

Run: python tests/benchmarks/kinect_capture.py
The virtual bus runs in the same process, copies every packet and is part of the cost; a real USB controller
writes packets into memory by itself.
"""

import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rig_agent.encoder import encode_frame
from rig_agent.sources.freenect import FreenectSettings, FreenectSource
from rig_agent.sources.freenect_formats import DepthName
from rig_protocol.codecs import codec_by_name
from rig_protocol.frames import RgbdFrame
from support import process_meter
from support.virtual_usb.virtual_bus import VirtualBus, enter, kinect_frames

FRAMES, LOSSY_FRAMES = 600, 1500
LOSS_PERCENT = 0.1
DEPTH_FORMATS: tuple[DepthName, ...] = ("11bit", "11bit_packed")


@dataclass
class Exactness:
    """Frames by what they are and what they are said to be."""

    whole: int = 0
    flagged: int = 0
    torn_without_flag: int = 0

    def add(self, frame: RgbdFrame) -> None:
        """Byte for byte against what the bus sent."""
        if frame.damaged:
            self.flagged += 1
        elif is_exact(frame):
            self.whole += 1
        else:
            self.torn_without_flag += 1


def is_exact(frame: RgbdFrame) -> bool:
    """Whether depth and colour are one recorded frame."""
    recorded = kinect_frames()
    index = None if frame.raw is None else recorded.index_of(frame.raw)
    return index is not None and np.array_equal(frame.bayer, recorded.bayer[index])


def capture_cost(depth_format: DepthName, frames: int = FRAMES) -> tuple[process_meter.Cost, float, int]:
    """Cost a second, frames a second by the device's clock, frames that nobody read in time."""
    with FreenectSource(FreenectSettings(depth_format=depth_format)) as source:
        _next(source)
        before = process_meter.read()
        times_ns = [_next(source).timestamp_ns for _ in range(frames)]
        cost = process_meter.cost(before, process_meter.read())
        overrun = source.counters["overrun"]
    rate = (frames - 1 + overrun) / (times_ns[-1] - times_ns[0]) * 1e9
    return cost, rate, overrun


def exactness(frames: int) -> Exactness:
    """Of so many frames as they come."""
    found = Exactness()
    with FreenectSource(FreenectSettings()) as source:
        for _ in range(frames):
            found.add(_next(source))
    return found


def encoding_ms() -> float:
    """Processor time to encode a frame losslessly, both images."""
    recorded = kinect_frames()
    codecs = codec_by_name("bayer-lossless").id, codec_by_name("disparity-lossless").id
    frames = [RgbdFrame(0, 0, 0, bayer=b, raw=r) for b, r in zip(recorded.bayer, recorded.raw, strict=True)]
    for frame in frames:
        encode_frame(frame, *codecs)
    began_s = time.process_time()
    for frame in frames:
        encode_frame(frame, *codecs)
    return (time.process_time() - began_s) / len(frames) * 1e3


def report() -> None:
    """Print the figures, on a bus of one Kinect."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        bus = VirtualBus(Path(folder) / "usb")
        enter(bus, patch)
        kinect = bus.add_kinect("A00364A11111111A")
        for depth_format in DEPTH_FORMATS:
            cost, rate, overrun = capture_cost(depth_format)
            print(
                f"capture, Bayer and {depth_format}: {100 * cost.cores:.1f} % of a core, "
                f"{rate:.3f} frames/s, {overrun} of {FRAMES} not read in time"
            )
        ms = encoding_ms()
        print(f"encoding: {ms:.2f} ms a frame, {3 * ms:.1f} % of a core at 30 frames/s")
        found = exactness(FRAMES)
        print(f"without loss: {found.whole} of {FRAMES} exact, {found.flagged} flagged")
        kinect.write("lose", str(LOSS_PERCENT))
        found = exactness(LOSSY_FRAMES)
        print(
            f"{LOSS_PERCENT} % of packets lost: {found.flagged} of {LOSSY_FRAMES} frames flagged, "
            f"{found.whole} exact, {found.torn_without_flag} torn without flag"
        )


def _next(source: FreenectSource) -> RgbdFrame:
    frame = source.read(3.0)
    if frame is None:
        raise RuntimeError("no frame for 3 s")
    return frame


if __name__ == "__main__":
    report()
