"""Twelve cameras recorded by a real server, to the end and to a kill: `bench_recording.py [FOLDER]`.

Encoded frames of real Kinect images play over loopback UDP at 30 frames a second; `rig-server --record` is a
process of its own. First for so many seconds (60): nothing may be missing, and every payload in the file must
be, byte for byte, the one that was sent. Then it is killed with signal 9 in the middle of another take: what
the file lost is the time between the kill and its last frame; it is replayed, recovered, replayed again.
"""

import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from console_latency import looked_at

from rig_protocol.frames import EncodedFrame
from rig_protocol.recording import MANIFEST, Recording, recover
from rig_server import Rig
from rig_server.config import ConsoleSettings, RigSettings
from rig_server.replay import ReplayOptions
from support.benchmark_record import machine, merge_results, results_of, write_section
from support.browser import chromium_path
from support.key_for_tests import rig_key_file
from support.preencoded_frames import PreencodedFrames
from support.preencoded_sender import Play, encoded_file, sender_process, total
from support.rig_processes import free_port

CAMERAS, FPS = 12, 30.0
SECONDS, LOOK_SECONDS, KILL_SECONDS = 60.0, 10.0, 12.0
_PROBE_BYTES = 1 << 30


@contextmanager
def recording_server(take: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """`rig-server --record` and its port; ended with the block."""
    port = free_port()
    words = [sys.executable, "-m", "rig_server.cli", "--listen", f"127.0.0.1:{port}", "--record", str(take)]
    environment = os.environ | {
        "RIG_SERVER_KEY_FILE": str(rig_key_file()),
        "RIG_SERVER_EXPECTED_CAMERAS": str(CAMERAS),
        "RIG_SERVER_CONTROL_SOCKET": str(take.with_suffix(".sock")),
    }
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, env=environment, text=True) as process:
        try:
            yield process, port
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)


def frames_of(take: Path) -> Iterator[EncodedFrame]:
    """What the file holds."""
    return (entry for entry in Recording(take).entries() if isinstance(entry, EncodedFrame))


def wrong_payloads(take: Path, sent: PreencodedFrames) -> tuple[int, int, int]:
    """Frames and bytes in the file, and how many frames are not what was sent."""
    frames = size = wrong = 0
    for one in frames_of(take):
        expected = sent.frame(one.camera_id, one.sequence, one.timestamp_ns)
        for payload, original in ((one.color, expected.color), (one.depth, expected.depth)):
            assert payload is not None
            assert original is not None
            wrong += bytes(payload.data) != bytes(original.data)
            size += len(payload.data)
        frames += 1
    return frames, size, wrong


def recorded(take: Path, seconds: float, file: Path, sent: PreencodedFrames) -> dict[str, Any]:
    """A take that ends in order."""
    with recording_server(take) as (server, port):
        play = Play(f"127.0.0.1:{port}", range(CAMERAS), FPS, seconds)
        with sender_process(play, file) as sender:
            result = sender.result(seconds + 120)
    assert server.returncode == 0, f"the server ended with {server.returncode}"
    manifest = Recording(take).document(MANIFEST)
    frames, size, wrong = wrong_payloads(take, sent)
    return {
        "seconds": seconds,
        "sent": total(result, "sent"),
        "recorded": frames,
        "record_dropped": sum(one["frames"] for one in manifest["not_recorded"].values()),
        "network_lost": sum(one["lost"] for one in manifest["received"].values()),
        "wrong": wrong,
        "mb_s": round(size / seconds / 1e6, 1),
    }


def replayed_beside_console(take: Path) -> dict[str, Any]:
    """The take played as fast as it was recorded, while a browser looks at the console."""
    chromium = chromium_path()
    if chromium is None:
        return {"skipped": "there is no Chromium on this machine: apt install chromium"}
    settings = RigSettings(console=ConsoleSettings(listen="127.0.0.1:0"))
    seen = looked_at(Rig.replayed(take, settings, ReplayOptions(loop=True)), LOOK_SECONDS, chromium)
    return {name: seen[name] for name in ("sets_per_s", "tiles_per_s")}


def killed(take: Path, seconds: float, file: Path) -> dict[str, Any]:
    """A take whose server is killed in the middle."""
    with recording_server(take) as (server, port):
        play = Play(f"127.0.0.1:{port}", range(CAMERAS), FPS, seconds + 60)
        with sender_process(play, file):
            _wait_for_bytes(take, seconds / 2 * 70e6)
            server.kill()
            killed_ns = time.monotonic_ns()
            server.wait()
    lost_s = (killed_ns - max(one.received_ns or 0 for one in frames_of(take))) / 1e9
    before = digest(take)
    mended = recover(take)
    after = digest(take)
    return {
        "kill_lost_s": round(lost_s, 3),
        "torn_sets": before[1],
        "mended": bool(mended),
        "replay_identical": before == after,
    }


def digest(take: Path) -> tuple[str, int]:
    """Of every set that a replay gives, every field, and how many."""
    sum_of_all, count = hashlib.sha256(), 0
    with Rig.replayed(take, RigSettings(), ReplayOptions(speed=None)) as rig:
        for panorama in rig:
            count += 1
            for camera_id, frame in panorama.frames.items():
                sum_of_all.update(f"{panorama.index} {camera_id} {frame and frame.timestamp_ns}".encode())
                for image in () if frame is None else (frame.bayer, frame.raw):
                    sum_of_all.update(b"" if image is None else image.tobytes())
    return sum_of_all.hexdigest(), count


def disk_mb_s(folder: Path) -> float:
    """A plain writer, made to wait until all is on the disk."""
    block, begun_s = os.urandom(4 << 20), time.monotonic()
    with (folder / "probe").open("wb", buffering=0) as probe:
        for _ in range(_PROBE_BYTES // len(block)):
            probe.write(block)
        os.fsync(probe.fileno())
    (folder / "probe").unlink()
    return round(_PROBE_BYTES / (time.monotonic() - begun_s) / 1e6, 1)


def measure(folder: Path, seconds: float = SECONDS) -> dict[str, Any]:
    """Both takes; what `fusion.recording` of bench.json holds."""
    results: dict[str, Any] = {"disk_mb_s": disk_mb_s(folder)}
    with encoded_file() as (file, sent):
        take = folder / "whole.mcap"
        results |= recorded(take, seconds, file, sent)
        results["console_beside_replay"] = replayed_beside_console(take)
        take.unlink()
        return results | killed(folder / "killed.mcap", KILL_SECONDS, file)


def _wait_for_bytes(take: Path, size: float) -> None:
    until_s = time.monotonic() + 120
    while not take.is_file() or take.stat().st_size < size:
        assert time.monotonic() < until_s, "nothing is recorded"
        time.sleep(0.02)


def console_sentence(seen: dict[str, Any]) -> str:
    """What a browser was shown of the replay."""
    if "skipped" in seen:
        return f"Replay beside the console was not measured: {seen['skipped']}."
    return f"""The take replayed as fast as it was recorded, while a headless Chromium looks at the console:
{seen["sets_per_s"]:.1f} sets and {seen["tiles_per_s"]:.0f} tiles a second."""


def report(results: dict[str, Any]) -> str:
    """The section of docs/performance.md."""
    same = "the same" if results["replay_identical"] else "**not** the same"
    command = "`python tests/benchmarks/bench_recording.py`"
    return f"""## Recording

{command} on {machine("mcap")}; load {results["load_before"]:.1f} before.
Encoded frames of real Kinect images, twelve cameras at 30 frames a second over loopback UDP,
`rig-server --record` in a process of its own.

{results["seconds"]:.0f} s: {results["sent"]} frames sent, {results["recorded"]} in the file,
**{results["record_dropped"]} dropped by the recorder**, {results["network_lost"]} lost by the network;
{results["wrong"]} payloads differ from those sent; {results["mb_s"]:.1f} MB/s.
A plain writer fills this disk with {results["disk_mb_s"]:.0f} MB/s.

{console_sentence(results["console_beside_replay"])}

Killed with signal 9 in the middle of a take: the file lacks the last **{results["kill_lost_s"]:.2f} s**. Its
{results["torn_sets"]} sets are {same}, bit for bit, before and after `rig-server recover`."""


def main() -> None:
    """Measure, record, print."""
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(dir=sys.argv[1] if len(sys.argv) > 1 else None) as folder:
        results = measure(Path(folder)) | {"load_before": load}
    section = (results_of("fusion") or {}) | {
        "record_dropped": results["record_dropped"],
        "recording": results,
    }
    merge_results({"fusion": section})
    write_section("recording", report(results))
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
