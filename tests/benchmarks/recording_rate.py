"""What the recorder puts on the disk without a drop: `recording_rate.py [SECONDS] [FOLDER]`.

Twelve cameras at 30 frames a second, each of as many bytes as real ones have; then all is read back and
compared, bit for bit.
"""

import json
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.recorder import TakeContext
from rig_protocol.recording import Recording
from rig_server.config import RecordingSettings
from rig_server.sinks.record import RecordSink

CAMERAS, FPS = 12, 30
# What the codecs make of real frames (docs/performance.md): 72 MB/s for the whole rig.
COLOR_BYTES, DEPTH_BYTES = 150_000, 52_000


def payload(camera_id: int, k: int, size: int, codec_id: int, noise: bytes) -> Payload:
    start = (camera_id * 977 + k * 131) % 4096
    return Payload(codec_id, noise[start : start + size])


def frame(camera_id: int, k: int, noise: bytes) -> EncodedFrame:
    return EncodedFrame(
        camera_id=camera_id,
        sequence=k,
        timestamp_ns=k * 33_333_333 + camera_id,
        color=payload(camera_id, k, COLOR_BYTES, 1, noise),
        depth=payload(camera_id, k, DEPTH_BYTES, 2, noise),
        received_ns=k * 33_333_333 + camera_id,
    )


def measure(seconds: float, folder: Path) -> dict[str, float]:
    """Record for so long at the rig's rate, then read everything back."""
    noise = np.random.default_rng(0).bytes(COLOR_BYTES + 4096)
    take = folder / "take.mcap"
    sink = RecordSink(take, RecordingSettings(), TakeContext())
    sink.start()
    cpu_s, begun_s = cpu(), time.monotonic()
    count = round(seconds * FPS)
    most_waiting = 0
    for k in range(count):
        for camera_id in range(CAMERAS):
            sink.add(frame(camera_id, k, noise))
        most_waiting = max(most_waiting, sink.status().waiting_bytes)
        time.sleep(max(0.0, begun_s + (k + 1) / FPS - time.monotonic()))
    elapsed_s = time.monotonic() - begun_s
    sink.stop()
    cores, status = (cpu() - cpu_s) / elapsed_s, sink.status()
    begun_s = time.monotonic()
    wrong = read = 0
    for one in Recording(take).entries():
        assert isinstance(one, EncodedFrame)
        wrong += one != frame(one.camera_id, one.sequence, noise)
        read += 1
    return {
        "seconds": round(elapsed_s, 1),
        "offered": count * CAMERAS,
        "record_dropped": status.dropped,
        "recorded": read,
        "wrong": wrong,
        "mb_s": round(status.bytes / elapsed_s / 1e6, 1),
        "cores": round(cores, 2),
        "most_waiting_mb": round(most_waiting / 1e6, 1),
        "read_mb_s": round(status.bytes / (time.monotonic() - begun_s) / 1e6, 1),
    }


def cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(dir=sys.argv[2] if len(sys.argv) > 2 else None) as name:
        print(json.dumps(measure(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0, Path(name)), indent=1))
