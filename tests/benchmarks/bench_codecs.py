"""Size, time and losslessness of every codec on real frames: docs/performance.md and build/bench.json.

make bench-codecs
"""

import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Semaphore
from typing import Any

import cv2
import numpy as np
import pytest
from rich.progress import Progress

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rig_agent.encoder import encode_frame
from rig_protocol.codecs import codec, codec_by_name, codecs_for, warm_up
from rig_protocol.frames import EncodedFrame, RgbdFrame
from rig_server.decoder import FrameDecoder, decode_frame
from support.benchmark_record import machine, markdown_table, merge_results, write_section
from support.images import mosaic, read_image
from support.real_data import real_data

REPEATS = 7
SCALING_FRAMES = 600

Images = dict[str, list[Any]]


@dataclass(frozen=True)
class Row:
    """One codec on one kind of image; times are those of the quickest repeat, averaged over the images."""

    codec: str
    image: str
    kib: float
    encode_ms: float
    decode_ms: float
    lossless: bool


def load_images() -> Images:
    """Real images by kind; a Bayer image is the channel of each pixel that the sensor would have seen."""
    recorded, views = real_data("kinect_v1_raw"), real_data("tum_fr1_rpy_12views")
    colors = [read_image(path) for path in sorted(views.glob("cam*/color_*.png"))]
    return {
        "raw": [read_image(path) for path in sorted(recorded.glob("*raw*.png"))],
        "bayer": [mosaic(image) for image in colors],
        "bayer (pair)": [mosaic(read_image(recorded / "pair_color.png"))],
        "depth_mm": [read_image(path) for path in sorted(views.glob("cam*/registered_*.png"))],
        "bgr": colors,
        "grey": [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in colors],
    }


def quickest_ms(function: Callable[[], object]) -> float:
    """The shortest of a few runs: what else the machine does only ever adds."""
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter_ns()
        function()
        times.append(time.perf_counter_ns() - start)
    return min(times) / 1e6


def measure(name: str, kind: str, images: Sequence[Any], advance: Callable[[], None]) -> Row:
    """One row of the table."""
    one = codec_by_name(name)
    sizes, encode_ms, decode_ms, exact = [], [], [], True
    for image in images:
        data = one.encode(image)
        exact &= np.array_equal(one.decode(data), image)
        sizes.append(len(data) / 1024)
        encode_ms.append(quickest_ms(lambda image=image: one.encode(image)))
        decode_ms.append(quickest_ms(lambda data=data: one.decode(data)))
        advance()
    if one.lossless and not exact:
        raise SystemExit(f"{name} lost pixels of {kind}")
    mean_kib, mean_encode_ms, mean_decode_ms = (
        float(np.mean(values)) for values in (sizes, encode_ms, decode_ms)
    )
    return Row(name, kind, mean_kib, mean_encode_ms, mean_decode_ms, exact)


def pairs_of(images: Images) -> list[RgbdFrame]:
    """What an agent sends by default: Bayer and disparity."""
    both = zip(images["bayer"], images["raw"], strict=False)
    return [RgbdFrame(i, 0, 0, bayer=bayer, raw=raw) for i, (bayer, raw) in enumerate(both)]


def encode_pair(frame: RgbdFrame) -> EncodedFrame:
    """A frame in the default codecs."""
    return encode_frame(frame, codecs_for("bayer")[0], codecs_for("raw")[0])


def decoded_per_second(frames: Sequence[EncodedFrame], threads: int) -> float:
    """Frames a second through the server's decoder threads."""
    done = Semaphore(0)
    decoder = FrameDecoder(lambda _: done.release(), threads=threads, capacity=SCALING_FRAMES)
    start = time.perf_counter()
    for i in range(SCALING_FRAMES):
        decoder.submit(frames[i % len(frames)])
    for _ in range(SCALING_FRAMES):
        done.acquire()
    seconds = time.perf_counter() - start
    decoder.close()
    return SCALING_FRAMES / seconds


def run() -> dict[str, Any]:
    """The section `codecs` of bench.json."""
    images = load_images()
    cores = os.sched_getaffinity(0)
    cv2.setNumThreads(1)
    warm_up()
    plan = [(codec(id_).name, kind) for kind in images for id_ in codecs_for(kind.split()[0])]  # type: ignore[arg-type]
    with Progress() as progress:
        task = progress.add_task("codecs", total=sum(len(images[kind]) for _, kind in plan))
        os.sched_setaffinity(0, {max(cores)})
        rows = [measure(name, kind, images[kind], lambda: progress.advance(task)) for name, kind in plan]
        frames = pairs_of(images)
        encoded = [encode_pair(frame) for frame in frames]
        encode_ms = np.mean([quickest_ms(lambda frame=frame: encode_pair(frame)) for frame in frames])
        decode_ms = np.mean([quickest_ms(lambda frame=frame: decode_frame(frame)) for frame in encoded])
        os.sched_setaffinity(0, cores)
    kib = {(row.codec, row.image): row.kib for row in rows}
    return {
        "disparity_kib": kib["disparity-lossless", "raw"],
        "bayer_kib": kib["bayer-lossless", "bayer"],
        "bayer_pair_kib": kib["bayer-lossless", "bayer (pair)"],
        "pair_encode_ms": float(encode_ms),
        "pair_decode_ms": float(decode_ms),
        "decoded_per_s": {str(threads): decoded_per_second(encoded, threads) for threads in (1, 2)},
        "table": [asdict(row) for row in rows],
    }


def report(results: dict[str, Any]) -> str:
    """The codec section of docs/performance.md."""
    rows = [
        [
            row["codec"],
            row["image"],
            f"{row['kib']:.1f}",
            f"{row['encode_ms']:.2f}",
            f"{row['decode_ms']:.2f}",
            "yes" if row["lossless"] else "no",
        ]
        for row in results["table"]
    ]
    table = markdown_table(["codec", "image", "KiB", "encode ms", "decode ms", "lossless"], rows)
    pair_kib = results["bayer_kib"] + results["disparity_kib"]
    one, two = (results["decoded_per_s"][threads] for threads in ("1", "2"))
    return f"""## Codecs

`make bench-codecs` on {machine("numpy", "opencv-python-headless", "zstandard", "numba")}.

Real 640×480 frames: `raw` are the 13 disparity images of `kinect_v1_raw`, `bayer (pair)` its colour image;
the others are the 12 views of `tum_fr1_rpy_12views`. Bayer images are re-mosaicked from the lossless colour,
`depth_mm` is registered depth. One core; the quickest of {REPEATS} runs an image, averaged over the images.

{table}

By default an agent sends Bayer and disparity, both lossless: {pair_kib:.0f} KiB a frame, encoded in
{results["pair_encode_ms"]:.1f} ms and decoded in {results["pair_decode_ms"]:.2f} ms of one core.
Twelve cameras at 30 frames a second are {pair_kib * 1024 * 360 / 1e6:.0f} MB/s of payload. The server's
decoder takes {one:.0f} such pairs a second on one thread and {two:.0f} on two; the rig needs 360."""


def main() -> None:
    """Measure, record, print."""
    try:
        results = run()
    except pytest.skip.Exception as reason:
        merge_results({"codecs": {"skipped": str(reason)}})
        raise SystemExit(str(reason)) from None
    merge_results({"codecs": results})
    write_section("codecs", report(results))
    print(report(results))


if __name__ == "__main__":
    main()
