"""A recorded Kinect on the virtual USB bus through agent and UDP to the server: rate, exactness, replug.

Run: python tests/benchmarks/bench_kinect.py
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rig_protocol.frames import PanoramicFrame
from rig_server import Rig
from support.rig_processes import AgentProcess, free_port, is_complete, server_settings, wait_for_set
from support.virtual_usb.virtual_bus import VirtualBus, VirtualKinect, environment, kinect_frames

FRAMES, REPLUGS = 300, 5


def is_exact(panorama: PanoramicFrame) -> bool:
    """Whether depth and colour are one recorded frame, byte for byte."""
    frame, recorded = panorama.frames[0], kinect_frames()
    index = None if frame is None or frame.raw is None else recorded.index_of(frame.raw)
    return frame is not None and index is not None and np.array_equal(frame.bayer, recorded.bayer[index])


def seconds_to_return(rig: Rig, kinect: VirtualKinect) -> float:
    """From plugging in to the first set."""
    kinect.unplug()
    while rig.next_panorama(1.0) is not None:
        continue
    plugged_s = time.monotonic()
    kinect.plug()
    wait_for_set(rig, is_complete)
    return time.monotonic() - plugged_s


def main() -> None:
    """Print the figures."""
    with tempfile.TemporaryDirectory() as folder:
        bus, port = VirtualBus(Path(folder) / "usb"), free_port()
        kinect = bus.add_kinect("A00364A11111111A")
        options = ["--source", "freenect", "--camera", 0]
        agent = AgentProcess(Path(folder) / "agent.log", port, options, environment(bus)).start()
        with Rig.live(server_settings(port, 1)) as rig:
            wait_for_set(rig, is_complete)
            sets = [wait_for_set(rig, is_complete) for _ in range(FRAMES)]
            lost = sum(camera.lost for camera in rig.status().cameras)
            replugs_s = [seconds_to_return(rig, kinect) for _ in range(REPLUGS)]
        status = agent.stop()
    elapsed_s = (sets[-1].timestamp_ns - sets[0].timestamp_ns) / 1e9
    print(
        f"{(FRAMES - 1) / elapsed_s:.3f} frames/s, {sum(map(is_exact, sets))} of {FRAMES} exact, {lost} lost"
    )
    print(f"back after replug: {', '.join(f'{s:.2f}' for s in replugs_s)} s; agent ended with {status}")


if __name__ == "__main__":
    main()
