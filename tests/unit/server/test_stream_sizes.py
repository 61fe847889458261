"""Expected sizes are those that the codecs have; measured ones follow the scene."""

import re
from pathlib import Path

import numpy as np
import pytest

from rig_protocol.codecs import COLOR_CODECS, DEPTH_CODECS, codec, codec_by_name
from rig_protocol.frames import EncodedFrame, Payload
from rig_server.stream_sizes import MeasuredSizes, expected_bytes, paper_bytes, planned_bytes, worst_bytes

VGA = 640 * 480
SECOND_NS = 1_000_000_000
T0 = 1000 * SECOND_NS
PERFORMANCE = Path(__file__).resolve().parents[3] / "docs" / "performance.md"


@pytest.mark.parametrize("codec_id", COLOR_CODECS + DEPTH_CODECS)
def test_noise_takes_what_the_worst_case_says_and_never_more(codec_id: int) -> None:
    one = codec(codec_id)
    shape = (480, 640, 3) if one.image == "bgr" else (480, 640)
    limit, dtype = {"raw": (2048, np.uint16), "depth_mm": (9000, np.uint16)}.get(one.image, (256, np.uint8))
    noise = np.random.default_rng(1).integers(0, limit, shape).astype(dtype)
    assert len(one.encode(noise)) == pytest.approx(worst_bytes(codec_id, VGA), rel=0.02)
    assert len(one.encode(noise)) <= worst_bytes(codec_id, VGA) + 6  # the image header


def test_expectations_are_the_sizes_that_the_benchmark_measured() -> None:
    table = re.findall(r"^\| ([a-z-]+) \| [a-z_]+ \| ([\d.]+) \|", PERFORMANCE.read_text(), re.MULTILINE)
    assert {name for name, _ in table} >= {"bayer-lossless", "disparity-lossless", "bgr-jpeg"}
    for name, kib in table:
        expected = expected_bytes(codec_by_name(name).id, VGA) / 1024
        assert expected == pytest.approx(float(kib), rel=0.15), name


def test_the_margin_never_exceeds_the_worst_case() -> None:
    bayer, raw = codec_by_name("bayer-lossless").id, codec_by_name("bayer-uncompressed").id
    assert planned_bytes(bayer, VGA, 1.25) == 1.25 * expected_bytes(bayer, VGA)
    assert planned_bytes(bayer, VGA, 10.0) == worst_bytes(bayer, VGA)
    assert planned_bytes(raw, VGA, 1.25) == VGA


def test_the_papers_frame_is_five_bytes_a_pixel() -> None:
    assert paper_bytes() == 1_536_000


def measured(sizes: list[int], codec_id: int = 1, start_ns: int = T0) -> MeasuredSizes:
    known = MeasuredSizes()
    for index, size in enumerate(sizes):
        frame = EncodedFrame(0, index, 0, color=Payload(codec_id, bytes(size)))
        known.add(frame, start_ns + index * SECOND_NS // 30)
    return known


def test_a_first_dark_frame_is_not_taken_for_the_scene() -> None:
    assert measured([10]).mean(1, T0) is None
    assert measured([300] * 4).mean(1, T0) == 300


def test_the_mean_follows_the_scene_within_a_second() -> None:
    assert measured([100] * 60 + [200] * 30).mean(1, T0) == pytest.approx(200, rel=0.02)


def test_a_codec_that_was_not_in_use_for_a_minute_is_forgotten() -> None:
    known = measured([300] * 30)
    assert known.mean(1, T0 + 59 * SECOND_NS) == 300
    assert known.mean(1, T0 + 62 * SECOND_NS) is None
    known.add(EncodedFrame(0, 31, 0, color=Payload(1, bytes(100))), T0 + 62 * SECOND_NS)
    assert known.mean(1, T0 + 62 * SECOND_NS) is None
