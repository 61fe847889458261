"""Section `rig`: twelve cameras at 30 frames a second into a real server, every frame decoded and demosaiced.

python tests/benchmarks/transport_rig.py
"""

import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from support.measured_server import WARM_UP_S, Measurement, measured_server
from support.preencoded_sender import Play, encoded_file, sender_process, total
from support.process_meter import growth_mb, wait_for_calm

CAMERAS, FPS, SECONDS = 12, 30.0, 20.0
SETTINGS = {"demosaic": True}
# Another program on the machine spoils a run. Of a few runs the one that was disturbed least counts, and
# a run with less than this of a core taken by others is good enough.
ATTEMPTS, DISTURBED_CORES, PATIENCE_S = 3, 0.1, 60.0


def run() -> dict[str, Any]:
    """The section `rig` of bench.json."""
    runs = []
    with encoded_file() as (file, frames):
        for _ in range(ATTEMPTS):
            wait_for_calm(DISTURBED_CORES, PATIENCE_S)
            runs.append(one_run(file))
            if runs[-1]["others_cores"] < DISTURBED_CORES:
                break
        facts = {"frames": frames.origin, "frame_kib": frames.frame_bytes / 1024}
    best = min(runs, key=lambda one: float(one["others_cores"]))
    return best | facts | {"tries": ATTEMPTS, "attempts": runs}


def one_run(file: Path) -> dict[str, Any]:
    """Server and sender are processes of their own; the figures are the server's."""
    with measured_server(CAMERAS, SECONDS, FPS, SETTINGS) as server:
        play = Play(f"127.0.0.1:{server.port}", range(CAMERAS), FPS, WARM_UP_S + SECONDS + 4.0)
        with sender_process(play, file) as sender:
            measured, sent = server.result(), sender.result()
    return figures(measured) | {
        "sender_cores": sent["cores"],
        "sender_dropped": total(sent, "dropped"),
        "others_cores": max(0.0, measured.cost.machine_cores - measured.cost.cores - sent["cores"]),
    }


def figures(measured: Measurement) -> dict[str, Any]:
    """What bench.json keeps of a measurement."""
    median_ms, _, p99_ms, longest_ms = measured.latency_ms
    return {
        "complete_sets": measured.complete_sets / measured.expected_sets,
        "expected_sets": measured.expected_sets,
        "fps": measured.complete_sets / measured.seconds,
        "server_cores": measured.cost.cores,
        "p50_ms": median_ms,
        "p99_ms": p99_ms,
        "longest_ms": longest_ms,
        "rss_growth_mb": growth_mb(measured.rss_mb),
        "rss_mb": measured.rss_mb[-1][1],
        "authenticated": measured.authenticated,
        "thread_cores": measured.cost.thread_cores,
        "minor_faults_per_s": measured.cost.minor_faults,
        "dropped": {cause: count for cause, count in measured.dropped.items() if count},
    }


def main() -> None:
    """Print the section."""
    print(json.dumps(run(), indent=1))


if __name__ == "__main__":
    main()
