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
from rig_protocol.codecs import Codec, codec, codecs_for, keep_freed_memory, warm_up
from rig_protocol.frames import EncodedFrame, RgbdFrame
from rig_server.decoder import FrameDecoder, decode_frame
from support.benchmark_record import machine, markdown_table, merge_results, write_section
from support.codec_peers import PEERS, Peer
from support.images import empty_of, mosaic, read_image
from support.real_data import real_data

REPEATS = 15
PAIR_REPEATS = 60
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


def quickest_ms(function: Callable[[], object], repeats: int = REPEATS) -> float:
    """The shortest of a few runs: what else the machine does only ever adds."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter_ns()
        function()
        times.append(time.perf_counter_ns() - start)
    return min(times) / 1e6


def as_peer(one: Codec) -> Peer:
    """One of the project's codecs, to be measured like the others."""
    return Peer(one.name, (one.image,), one.encode, lambda data, _: one.decode(data), one.lossless)


def peers_of(kind: str) -> list[Peer]:
    """The project's codecs of an image, then what others would use."""
    image = kind.split()[0]
    ours = [as_peer(codec(id_)) for id_ in codecs_for(image)]  # type: ignore[arg-type]  # the keys are kinds
    return ours + [peer for peer in PEERS if kind in peer.images]


def measure(peer: Peer, kind: str, images: Sequence[Any], advance: Callable[[], None]) -> Row:
    """One row of the table."""
    sizes, encode_ms, decode_ms, exact = [], [], [], True
    for image in images:
        data = peer.encode(image)
        exact &= np.array_equal(peer.decode(data, image), image)
        sizes.append(len(data) / 1024)
        encode_ms.append(quickest_ms(lambda image=image: peer.encode(image)))
        decode_ms.append(quickest_ms(lambda data=data, image=image: peer.decode(data, image)))
        advance()
    if peer.lossless and not exact:
        raise SystemExit(f"{peer.name} lost pixels of {kind}")
    mean_kib, mean_encode_ms, mean_decode_ms = (
        float(np.mean(values)) for values in (sizes, encode_ms, decode_ms)
    )
    return Row(peer.name, kind, mean_kib, mean_encode_ms, mean_decode_ms, exact)


def pairs_of(images: Images) -> list[RgbdFrame]:
    """What an agent sends by default: Bayer and disparity."""
    both = zip(images["bayer"], images["raw"], strict=False)
    return [RgbdFrame(i, 0, 0, bayer=bayer, raw=raw) for i, (bayer, raw) in enumerate(both)]


def encode_pair(frame: RgbdFrame) -> EncodedFrame:
    """A frame in the default codecs."""
    return encode_frame(frame, codecs_for("bayer")[0], codecs_for("raw")[0])


def decode_and_demosaic(frame: EncodedFrame) -> Any:
    """A pair as what is computed with takes it: Bayer made to BGR."""
    bayer = decode_frame(frame).bayer
    assert bayer is not None
    return cv2.cvtColor(bayer, cv2.COLOR_BayerGRBG2BGR)


def pair_ms(frames: Sequence[RgbdFrame]) -> dict[str, float]:
    """Times of the default codecs; `pair_lock_ms` is what a pair of 16×16 takes to decode.

    That is the part under the interpreter's lock: all that grows with the image runs without it.
    """
    tiny = encode_pair(RgbdFrame(0, 0, 0, bayer=empty_of("bayer", 16, 16), raw=empty_of("raw", 16, 16)))
    encoded = [encode_pair(frame) for frame in frames]
    calls: dict[str, list[Callable[[], object]]] = {
        "pair_encode_ms": [lambda frame=frame: encode_pair(frame) for frame in frames],
        "pair_decode_ms": [lambda frame=frame: decode_frame(frame) for frame in encoded],
        "pair_demosaic_ms": [lambda frame=frame: decode_and_demosaic(frame) for frame in encoded],
        "pair_lock_ms": [lambda: decode_frame(tiny)] * len(encoded),
    }
    return {
        name: float(np.mean([quickest_ms(call, PAIR_REPEATS) for call in several]))
        for name, several in calls.items()
    }


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
    keep_freed_memory()
    warm_up()
    plan = [(peer, kind) for kind in images for peer in peers_of(kind)]
    with Progress() as progress:
        task = progress.add_task("codecs", total=sum(len(images[kind]) for _, kind in plan))
        os.sched_setaffinity(0, {max(cores)})
        rows = [measure(peer, kind, images[kind], lambda: progress.advance(task)) for peer, kind in plan]
        frames = pairs_of(images)
        times = pair_ms(frames)
        os.sched_setaffinity(0, cores)
    encoded = [encode_pair(frame) for frame in frames]
    kib = {(row.codec, row.image): row.kib for row in rows}
    return {
        "disparity_kib": kib["disparity-lossless", "raw"],
        "bayer_kib": kib["bayer-lossless", "bayer"],
        "bayer_pair_kib": kib["bayer-lossless", "bayer (pair)"],
        **times,
        "decoded_per_s": {
            str(threads): max(decoded_per_second(encoded, threads) for _ in range(3)) for threads in (1, 2)
        },
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
    encode_ms, decode_ms, demosaic_ms, lock_ms = (
        results[f"pair_{step}_ms"] for step in ("encode", "decode", "demosaic", "lock")
    )
    return f"""## Codecs

`make bench-codecs` on {machine("numpy", "opencv-python-headless", "zstandard", "numba")}.

Real 640×480 frames: `raw` are the 13 disparity images of `kinect_v1_raw`, `bayer (pair)` its colour image;
the others are the 12 views of `tum_fr1_rpy_12views`. Bayer images are re-mosaicked from the lossless colour,
`depth_mm` is registered depth. One core; the quickest of {REPEATS} runs an image, averaged over the images
(of {PAIR_REPEATS} for pairs). `steps` are differences along the row in NumPy; JPEG XL and JPEG-LS are
missing for want of a library.

{table}

By default an agent sends Bayer and disparity, both lossless: {pair_kib:.0f} KiB a frame, encoded in
{encode_ms:.1f} ms and decoded in {decode_ms:.2f} ms of one core ({demosaic_ms:.2f} ms with demosaic).
The interpreter's lock is held for {lock_ms:.3f} ms of that, which is what a pair of 16×16 pixels takes.
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
