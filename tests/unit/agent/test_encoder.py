"""Frames become payloads in the codecs that were chosen."""

from dataclasses import replace

import numpy as np
import pytest

from rig_agent.encoder import codecs_to_keep, encode_frame, fits
from rig_protocol.codecs import codec_by_name
from rig_protocol.errors import DataError
from rig_protocol.frames import RgbdFrame
from support.images import mosaic, scene

BAYER, RAW = scene("bayer", 48, 64), scene("raw", 48, 64)
FRAME = RgbdFrame(
    3, 14, 15_000, 92, bayer=BAYER, raw=RAW, depth_frame="color", damaged=True
)  # fields that must all arrive


def wire_id(name: str) -> int:
    return codec_by_name(name).id


def test_identity_time_and_flags_go_along() -> None:
    encoded = encode_frame(FRAME, wire_id("bayer-lossless"), wire_id("disparity-lossless"))
    assert (encoded.camera_id, encoded.sequence) == (3, 14)
    assert (encoded.timestamp_ns, encoded.uncertainty_ns) == (15_000, 92)
    assert (encoded.depth_frame, encoded.damaged) == ("color", True)


def test_each_image_is_encoded_in_its_codec() -> None:
    encoded = encode_frame(FRAME, wire_id("bayer-lossless"), wire_id("disparity-uncompressed"))
    assert encoded.color is not None
    assert encoded.depth is not None
    assert encoded.color.codec_id == wire_id("bayer-lossless")
    assert encoded.depth.codec_id == wire_id("disparity-uncompressed")
    np.testing.assert_array_equal(codec_by_name("bayer-lossless").decode(encoded.color.data), BAYER)
    np.testing.assert_array_equal(codec_by_name("disparity-uncompressed").decode(encoded.depth.data), RAW)


def test_what_is_kept_is_lossless_whatever_the_network_wants() -> None:
    color, depth = codecs_to_keep(FRAME, "jpeg", "lossless")
    assert (color, depth) == (wire_id("bayer-lossless"), wire_id("disparity-lossless"))
    color, depth = codecs_to_keep(replace(FRAME, bayer=None, color=BAYER), "raw", "raw")
    assert (color, depth) == (wire_id("grey-uncompressed"), wire_id("disparity-uncompressed"))


def test_what_was_encoded_for_one_use_is_not_encoded_again_for_another() -> None:
    kept = encode_frame(FRAME, wire_id("bayer-lossless"), wire_id("disparity-lossless"))
    sent = encode_frame(FRAME, wire_id("bgr-jpeg"), wire_id("disparity-lossless"), kept)
    assert sent.depth is kept.depth
    assert sent.color is not None
    assert sent.color.codec_id == wire_id("bgr-jpeg")
    assert encode_frame(FRAME, None, None, kept).color is None


def test_a_stream_without_codec_is_not_sent() -> None:
    encoded = encode_frame(FRAME, None, None)
    assert encoded.color is None
    assert encoded.depth is None


def test_an_image_that_the_frame_lacks_is_not_sent() -> None:
    encoded = encode_frame(RgbdFrame(0, 0, 0), wire_id("bayer-lossless"), wire_id("disparity-lossless"))
    assert encoded.color is None
    assert encoded.depth is None


def test_a_bayer_image_is_demosaiced_for_jpeg() -> None:
    bgr = np.zeros((48, 64, 3), np.uint8)
    bgr[...] = (30, 90, 200)
    encoded = encode_frame(RgbdFrame(0, 0, 0, bayer=mosaic(bgr)), wire_id("bgr-jpeg"), None)
    assert encoded.color is not None
    decoded = codec_by_name("bgr-jpeg").decode(encoded.color.data)
    assert np.abs(decoded.astype(int) - bgr).max() <= 6


@pytest.mark.parametrize("kind", ["bgr", "grey"])
def test_colour_and_grey_images_have_codecs_of_their_own(kind: str) -> None:
    image = scene("bgr" if kind == "bgr" else "grey", 48, 64)
    encoded = encode_frame(RgbdFrame(0, 0, 0, color=image), wire_id(f"{kind}-lossless"), None)
    assert encoded.color is not None
    np.testing.assert_array_equal(codec_by_name(f"{kind}-lossless").decode(encoded.color.data), image)


@pytest.mark.parametrize(
    ("frame", "color", "depth", "fitting"),
    [
        (FRAME, "bayer-lossless", "disparity-lossless", True),
        (FRAME, "bgr-jpeg", None, True),
        (FRAME, "grey-lossless", None, False),
        (FRAME, None, "depth-lossless", False),
        (RgbdFrame(0, 0, 0, color=scene("grey", 48, 64)), "grey-lossless", "disparity-lossless", True),
        (RgbdFrame(0, 0, 0, color=scene("grey", 48, 64)), "bayer-lossless", None, False),
        (RgbdFrame(0, 0, 0, color=scene("bgr", 48, 64)), "grey-lossless", None, False),
    ],
)
def test_a_frame_fits_codecs_of_its_own_kinds(
    frame: RgbdFrame, color: str | None, depth: str | None, fitting: bool
) -> None:
    ids = [None if name is None else wire_id(name) for name in (color, depth)]
    assert fits(frame, *ids) is fitting


def test_a_codec_that_cannot_take_the_image_is_a_mistake_of_the_caller() -> None:
    with pytest.raises(ValueError, match="bayer"):
        encode_frame(RgbdFrame(0, 0, 0, color=scene("grey", 48, 64)), wire_id("bayer-lossless"), None)
    with pytest.raises(ValueError, match="grey-lossless cannot take"):
        encode_frame(FRAME, wire_id("grey-lossless"), None)
    with pytest.raises(ValueError, match="depth-lossless cannot take"):
        encode_frame(FRAME, None, wire_id("depth-lossless"))
    with pytest.raises(DataError, match="unknown"):
        encode_frame(FRAME, 250, None)
