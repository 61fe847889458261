"""Cost of the synchroniser a frame, and its sets: twelve free-running cameras at 30 fps in virtual time.

Run: python tests/benchmarks/bench_synchroniser.py
Drift ±100 ppm, jitter ±1 ms, arrival up to 5 ms apart; ten simulated minutes without loss, then with.
"""

import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from rig_protocol.frames import PanoramicFrame
from rig_protocol.synchroniser import Policy
from support.frame_streams import Arrival, free_running, joined

CAMERAS = 12
SLICE = 1200  # frames that are timed together: the quickest slice is what the machine can do undisturbed


def whole_rig(seconds: float, loss: float, seed: int = 1) -> list[Arrival]:
    """The frames of all cameras in the order in which they come."""
    rng = np.random.default_rng(seed)
    arrivals = [item for i in range(CAMERAS) for item in free_running(rng, i, seconds, loss=loss)]
    return sorted(arrivals, key=lambda pair: pair[0])


def measure(policy: Policy, seconds: float, loss: float) -> tuple[float, float, list[PanoramicFrame]]:
    """Microseconds a frame, the quickest and the median slice; the sets."""
    synchroniser = joined(range(CAMERAS), policy=policy)
    arrivals = whole_rig(seconds, loss)
    panoramas: list[PanoramicFrame] = []
    costs = []
    for start in range(0, len(arrivals) - SLICE, SLICE):
        start_ns = time.perf_counter_ns()
        for now_ns, item in arrivals[start : start + SLICE]:
            synchroniser.add(item, now_ns)
            while (panorama := synchroniser.next_panorama(now_ns)) is not None:
                panoramas.append(panorama)
        costs.append((time.perf_counter_ns() - start_ns) / SLICE / 1e3)
    return min(costs), float(np.median(costs)), panoramas


def main() -> None:
    """Print the table."""
    print("policy   loss %  us a frame: least, median  core at 360 frames/s  sets/s   complete %  spread ms")
    for policy in ("partial", "strict", "latest"):
        for loss, seconds in ((0.0, 600), (0.01, 120)):
            least_us, median_us, panoramas = measure(policy, seconds, loss)
            complete = [panorama for panorama in panoramas if panorama.complete]
            elapsed_s = (panoramas[-1].timestamp_ns - panoramas[0].timestamp_ns) / 1e9
            print(
                f"{policy:8} {100 * loss:6.1f} {least_us:18.1f} {median_us:7.1f} {36e-3 * median_us:20.2f} % "
                f"{(len(panoramas) - 1) / elapsed_s:8.2f} {100 * len(complete) / len(panoramas):12.3f} "
                f"{np.mean([panorama.spread_ns for panorama in complete]) / 1e6:11.1f}"
            )


if __name__ == "__main__":
    main()
