"""Offline work by 1, 2 and 4 workers: rate, equal results, and on paper where network or disk limits.

offline_scaling.py [FRAMES]: twelve simulated Kinects recorded to a take, exported as panoramas and as clouds.
"""

import hashlib
import os
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rig_agent.simulator.ring import VirtualRig, rig_description, true_poses
from rig_agent.simulator.settings import SimulatorSettings
from rig_calib.frame_exports.formats import FORMATS
from rig_calib.frame_exports.job import ExportJob
from rig_calib.offline.capture import Capture, open_capture
from rig_calib.offline.workers import Workers, open_workers
from rig_calib.rig_calibration import CalibratedCamera, RigCalibration
from rig_protocol.codecs import codec_by_name
from rig_protocol.frames import EncodedFrame, Payload, RgbdFrame
from rig_protocol.recording import CALIBRATION, DESCRIPTION, RecordingWriter
from rig_protocol.recording_format import RecordedSet
from support.benchmark_record import machine, markdown_table, merge_results, results_of, write_section

FRAMES = 32
REPEATS = 2
DIFFERENT_FRAMES = 3
WORKERS = (1, 2, 4)
WHAT = {"png": "panoramas (PNG)", "ply": "clouds (PLY)"}
START_NS, PERIOD_NS = 10_000_000_000, 33_333_333
LINKS_MB_S = {"1 Gbit/s network share": 117, "hard disk, 150 MB/s": 150, "SATA SSD, 500 MB/s": 500}
LINKS_MB_S |= {"10 Gbit/s network share": 1170, "NVMe SSD, 3000 MB/s": 3000}


def encoded(frame: RgbdFrame, time_ns: int) -> EncodedFrame:
    """As an agent sends it."""
    color, depth = codec_by_name("bayer-lossless"), codec_by_name("disparity-lossless")
    assert frame.bayer is not None
    assert frame.raw is not None
    return EncodedFrame(
        camera_id=frame.camera_id,
        sequence=frame.sequence,
        timestamp_ns=time_ns,
        uncertainty_ns=0,
        color=Payload(color.id, color.encode(frame.bayer)),
        depth=Payload(depth.id, depth.encode(frame.raw)),
        received_ns=time_ns + 20_000_000,
    )


def record(path: Path, frames: int) -> None:
    """A take of so many sets; the cameras see one of a few moments, again and again."""
    settings = SimulatorSettings()
    rig, description = VirtualRig(settings), rig_description(settings)
    ids = range(settings.cameras)
    seen = [[encoded(rig.camera(i).frame(k), 0) for i in ids] for k in range(DIFFERENT_FRAMES)]
    placed = tuple(CalibratedCamera(i, f"cam{i:02d}", T) for i, T in true_poses(settings).items())
    known = RigCalibration("truth", "ring", placed, (), None, {}, 1)
    with path.open("wb") as output:
        writer = RecordingWriter(output, "2026-01-02T03:04:05+00:00", START_NS)
        writer.attach(DESCRIPTION, description.to_dict(), START_NS)
        writer.attach(CALIBRATION, known.to_dict(), START_NS)
        for k in range(frames):
            time_ns = START_NS + k * PERIOD_NS
            for frame in seen[k % DIFFERENT_FRAMES]:
                writer.write(
                    replace(frame, sequence=k, timestamp_ns=time_ns, received_ns=time_ns + 20_000_000)
                )
            stamps: dict[int, int | None] = dict.fromkeys(ids, time_ns)
            writer.write(RecordedSet(k, time_ns + 25_000_000, stamps))
        writer.finish()


def processor_s() -> float:
    """Of this process and of all that it has started."""
    own = psutil.Process()
    times = [process.cpu_times() for process in (own, *own.children(recursive=True))]
    return sum(one.user + one.system for one in times)


def export(capture: Capture, positions: range, form: str, workers: Workers) -> tuple[float, float, str, int]:
    """Wall seconds, processor seconds of all workers, SHA-256 of all files, their bytes."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        begun_s, cpu_s = time.perf_counter(), processor_s()
        FORMATS[form].exporter()(ExportJob(capture, positions, out, workers, capture.calibration))
        taken_s, cpu_s = time.perf_counter() - begun_s, processor_s() - cpu_s
        told, size = hashlib.sha256(), 0
        for file in sorted(out.iterdir()):
            data = file.read_bytes()
            told.update(file.name.encode() + hashlib.sha256(data).digest())
            size += len(data)
    return taken_s, cpu_s, told.hexdigest(), size


def measure(capture: Capture, count: int) -> dict[str, Any]:
    """Start so many workers, let each make its tables, export."""
    positions, cores = range(len(capture.marks)), os.sched_getaffinity(0)
    if count == 1:  # fusion has threads of its own: a worker is a core
        os.sched_setaffinity(0, {min(cores)})
    measured: dict[str, Any] = {}
    try:
        with open_workers(count) as workers:
            begun_s = time.perf_counter()
            export(capture, positions[: 8 * count], "png", workers)
            measured["start_s"] = time.perf_counter() - begun_s
            for form in WHAT:
                runs = [export(capture, positions, form, workers) for _ in range(REPEATS)]
                seconds, cpu_s, digest, size = min(runs)
                measured[form] = {
                    "frames_s": len(positions) / seconds,
                    "cpu_s_frame": cpu_s / len(positions),
                    "sha256": digest,
                    "mb_frame": size / len(positions) / 1e6,
                }
    finally:
        os.sched_setaffinity(0, cores)
    return measured


def run(frames: int) -> dict[str, Any]:
    """The part `offline` of the section `fusion` of bench.json."""
    with tempfile.TemporaryDirectory() as folder:
        take = Path(folder) / "take.mcap"
        record(take, frames)
        load = os.getloadavg()[0]
        begun_s = time.perf_counter()
        capture = open_capture(take)
        opened_s = time.perf_counter() - begun_s
        return {
            "cores": len(os.sched_getaffinity(0)),
            "frames": frames,
            "take_mb_frame": take.stat().st_size / frames / 1e6,
            "open_s": opened_s,
            "load_before": load,
            "workers": {str(count): measure(capture, count) for count in WORKERS},
            "load_after": os.getloadavg()[0],
        }


def limits(results: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """By export and link: workers at which the link is full, bytes in and out over the same one."""
    alone, read_mb = results["workers"]["1"], results["take_mb_frame"]
    return {
        form: {
            link: mb_s * alone[form]["cpu_s_frame"] / (read_mb + alone[form]["mb_frame"])
            for link, mb_s in LINKS_MB_S.items()
        }
        for form in WHAT
    }


def scaling_table(results: Mapping[str, Any]) -> str:
    """Rates and efficiencies."""
    rows = []
    for count in WORKERS:
        row = [str(count)]
        for form in WHAT:
            rate, one = (results["workers"][k][form]["frames_s"] for k in (str(count), "1"))
            of_what = min(count, results["cores"])
            cpu_s = results["workers"][str(count)][form]["cpu_s_frame"]
            row += [f"{rate:.2f}", f"{rate / one / of_what:.0%}", f"{cpu_s:.2f}"]
        rows.append(row)
    heads = [
        head for what in WHAT.values() for head in (f"{what}: frames/s", "efficiency", "processor s a frame")
    ]
    return markdown_table(["workers", *heads], rows)


def limit_table(results: Mapping[str, Any]) -> str:
    """Where to stop adding workers."""
    found = limits(results)
    rows = [[link, *(_cores(found[form][link]) for form in WHAT)] for link in LINKS_MB_S]
    return markdown_table(["shared by all workers", *(f"{what}: full at" for what in WHAT.values())], rows)


def _cores(count: float) -> str:
    return f"{count:.1f}" if count < 2 else f"{count:.0f}"


def equal(results: Mapping[str, Any]) -> bool:
    """Whether every number of workers wrote the same bytes."""
    return all(len({one[form]["sha256"] for one in results["workers"].values()}) == 1 for form in WHAT)


def report(results: Mapping[str, Any]) -> str:
    """The section of docs/performance.md."""
    alone = results["workers"]["1"]
    costs = "; ".join(
        f"{what} {alone[form]['cpu_s_frame']:.2f} s and {alone[form]['mb_frame']:.1f} MB"
        for form, what in WHAT.items()
    )
    load = f"load {results['load_before']:.1f} before and {results['load_after']:.1f} after"
    cores, start_s, read_mb = results["cores"], results["workers"]["2"]["start_s"], results["take_mb_frame"]
    return f"""## Offline work by several workers

`tests/benchmarks/offline_scaling.py` on {machine("numpy", "numba", "distributed")};
{load}, other programs' included. `rig-calib export` of {results["frames"]}
panoramic frames of twelve simulated Kinects, the quickest of {REPEATS} runs. One worker is held to one core.
The machine has {cores}: efficiency is against so many times one worker, and more workers only show what too
many cost.

{scaling_table(results)}

The files are {"the same" if equal(results) else "NOT THE SAME"}, byte for byte (SHA-256), whatever the number
of workers. Before two workers are up and have made their tables, {start_s:.0f} s pass.

On paper: a panoramic frame is {read_mb:.2f} MB of the recording, and costs of processor time and of
the result {costs}. A share or a disk that all
workers read from and write to is full at so many cores, and more do not help:

{limit_table(results)}"""


def main() -> None:
    """Measure, record, print; exit 1 where results differ."""
    results = run(int(sys.argv[1]) if len(sys.argv) > 1 else FRAMES)
    results |= {"equal": equal(results), "limits_workers": limits(results)}
    merge_results({"fusion": {**(results_of("fusion") or {}), "offline": results}})
    write_section("offline", report(results))
    print(report(results))
    sys.exit(0 if results["equal"] else 1)


if __name__ == "__main__":
    main()
