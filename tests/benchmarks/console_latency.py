"""From a frame's last datagram to its tile painted in a real browser, the page's word back included.

python tests/benchmarks/console_latency.py [--seconds 20] [--cameras 12] [--fps 30]

Prints JSON, into build/bench.json and docs/performance.md, too: percentiles in ms, and `skipped` with the
reason where there is no Chromium. Cameras, server and browser share this machine. There is no calibration,
and so no cloud: without a GPU it is drawn in software, which would be measured. The bar is 200 ms.
"""

import argparse
import json
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rig_server import Rig
from rig_server.config import CameraSettings, ConsoleSettings, RigSettings
from rig_server.console.console import RigConsole
from support.benchmark_record import machine, merge_results, results_of, write_section
from support.browser import browser, chromium_path
from support.key_for_tests import rig_key_file
from support.preencoded_sender import Play, encoded_file, sender_process

WARM_UP_S = 5.0
SHARES = {"p50_ms": 0.5, "p95_ms": 0.95, "p99_ms": 0.99}


def console_latency(seconds: float = 15.0, cameras: int = 12, fps: float = 30.0) -> dict[str, Any]:
    """Percentiles over all tiles of so many seconds; `console_latency_ms` is the 95th."""
    chromium = chromium_path()
    if chromium is None:
        return {"skipped": "there is no Chromium on this machine: apt install chromium"}
    settings = RigSettings(
        listen="127.0.0.1:0",
        key_file=rig_key_file(),
        cameras=tuple(CameraSettings(id=i) for i in range(cameras)),
        console=ConsoleSettings(listen="127.0.0.1:0"),
    )
    rig = Rig.live(settings)
    play = Play(rig.place.removeprefix("UDP "), range(cameras), fps, seconds + 60.0)
    with encoded_file() as (file, _), sender_process(play, file):
        seen = looked_at(rig, seconds, chromium)
    return {"console_latency_ms": seen["p95_ms"], **seen, "cameras": cameras, "fps": fps}


def looked_at(rig: Rig, seconds: float, chromium: Path) -> dict[str, float | None]:
    """What a browser that looks at a rig for so many seconds is shown; the settings have a console."""
    with RigConsole(rig) as console, _taken(rig), browser(chromium, webgl=False) as opened:
        page = opened.new_page(viewport={"width": 1440, "height": 900})
        page.goto(console.link)
        page.wait_for_selector(".tile:not(.gone)", timeout=60_000)
        page.wait_for_timeout(1000 * WARM_UP_S)
        before, begin_s = console.latency(), time.monotonic()
        page.wait_for_timeout(1000 * seconds)
        seen, status = console.latency().since(before), rig.status()
        lasted_s = time.monotonic() - begin_s
    told = {name: _ms(seen.quantile_ns(share)) for name, share in SHARES.items()}
    rates = {"tiles_per_s": round(seen.count / lasted_s, 1), "sets_per_s": round(status.sets_per_s, 1)}
    return {**told, **rates}


@contextmanager
def _taken(rig: Rig) -> Iterator[None]:
    """The rig runs, and a thread takes its sets, as `rig-server` does."""
    over = threading.Event()

    def take() -> None:
        while not over.is_set():
            rig.next_panorama(0.25)

    with rig:
        thread = threading.Thread(target=take, name="taking", daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()


def _ms(duration_ns: float | None) -> float | None:
    return None if duration_ns is None else round(duration_ns / 1e6, 1)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--cameras", type=int, default=12)
    parser.add_argument("--fps", type=float, default=30.0)
    known = parser.parse_args()
    load = os.getloadavg()[0]
    results = console_latency(known.seconds, known.cameras, known.fps) | {"load_before": load}
    measured = {"console_latency_ms": results.get("console_latency_ms", results), "console": results}
    merge_results({"fusion": (results_of("fusion") or {}) | measured})
    write_section("console", report(results))
    print(json.dumps(results, indent=2))


def report(results: dict[str, Any]) -> str:
    """The section of docs/performance.md."""
    if "skipped" in results:
        return f"## Console\n\nNot measured: {results['skipped']}."
    return f"""## Console

`python tests/benchmarks/console_latency.py` on {machine("aiohttp", "playwright")};
load {results["load_before"]:.1f} before. {results["cameras"]} cameras at {results["fps"]:.0f} frames/s,
a headless Chromium that looks at all tiles, all on this machine. From a frame's last datagram to its
painted tile, the page's word back included: median
**{results["p50_ms"]:.0f} ms**, 95 % **{results["p95_ms"]:.0f} ms**, 99 % {results["p99_ms"]:.0f} ms;
{results["tiles_per_s"]:.0f} tiles and {results["sets_per_s"]:.1f} sets a second."""


if __name__ == "__main__":
    main()
