"""What a forged payload may not do: take memory, read elsewhere, or pass as an image."""

import struct
import tracemalloc

import numpy as np
import pytest
import zstandard

from rig_protocol.codecs import Codec, codec_by_name
from rig_protocol.codecs.base import MAX_SIDE
from rig_protocol.errors import DataError
from support.images import scene

COMPRESSED = ["bayer-lossless", "bgr-lossless", "grey-lossless", "disparity-lossless", "depth-lossless"]
COUNTS = {"disparity-lossless": 1, "depth-lossless": 2}

every_compressed_codec = pytest.mark.parametrize(
    "one", [codec_by_name(name) for name in COMPRESSED], ids=COMPRESSED
)


def parts(one: Codec, data: bytes) -> tuple[bytes, list[int], bytes]:
    """Header, stream lengths and decompressed streams of a payload."""
    count = COUNTS.get(one.name, 0)
    lengths = list(struct.unpack_from(f"<{count}I", data, 6))
    return data[:6], lengths, zstandard.ZstdDecompressor().decompress(data[6 + 4 * count :])


def joined(header: bytes, lengths: list[int], streams: bytes) -> bytes:
    return header + struct.pack(f"<{len(lengths)}I", *lengths) + zstandard.ZstdCompressor().compress(streams)


@every_compressed_codec
def test_a_tiny_payload_that_states_the_largest_image_takes_no_memory(one: Codec) -> None:
    _, lengths, streams = parts(one, one.encode(scene(one.image, 32, 32)))
    forged = joined(struct.pack("<BBHH", 2, 0, MAX_SIDE, MAX_SIDE), lengths, streams)
    tracemalloc.start()
    with pytest.raises(DataError):
        one.decode(forged)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1_000_000


@every_compressed_codec
def test_a_frame_that_does_not_state_its_size_is_refused(one: Codec) -> None:
    header, lengths, streams = parts(one, one.encode(scene(one.image, 32, 32)))
    compressor = zstandard.ZstdCompressor(write_content_size=False)
    forged = joined(header, lengths, b"")[: 6 + 4 * len(lengths)] + compressor.compress(streams)
    with pytest.raises(DataError, match="do not hold"):
        one.decode(forged)


@pytest.mark.parametrize("name", COMPRESSED[3:])
def test_stream_lengths_beyond_the_image_are_refused(name: str) -> None:
    one = codec_by_name(name)
    header, lengths, streams = parts(one, one.encode(scene(one.image, 32, 32)))
    for at in range(len(lengths)):
        forged = [2**32 - 1 if i == at else length for i, length in enumerate(lengths)]
        with pytest.raises(DataError):
            one.decode(joined(header, forged, streams))


@pytest.mark.parametrize("name", COMPRESSED[:3])
def test_more_or_fewer_residuals_than_pixels_are_refused(name: str) -> None:
    one = codec_by_name(name)
    header, _, streams = parts(one, one.encode(scene(one.image, 64, 64)))
    for forged in (streams[:-1], streams + b"\0", b""):
        with pytest.raises(DataError, match="do not hold"):
            one.decode(joined(header, [], forged))


@pytest.mark.parametrize("name", COMPRESSED[:3])
def test_any_residuals_are_an_image(name: str) -> None:
    one = codec_by_name(name)
    header, _, streams = parts(one, one.encode(scene(one.image, 64, 64)))
    forged = np.random.default_rng(0).bytes(len(streams))
    image = one.decode(joined(header, [], forged))
    np.testing.assert_array_equal(one.decode(one.encode(image)), image)


@pytest.mark.parametrize("name", COMPRESSED[3:])
def test_escapes_without_a_place_and_places_without_an_escape_are_refused(name: str) -> None:
    one = codec_by_name(name)
    header, lengths, streams = parts(one, one.encode(scene(one.image, 64, 64)))
    assert lengths[-1] > 0
    more = joined(header, [*lengths[:-1], lengths[-1] + 1], streams + b"\0\0")
    fewer = joined(header, [*lengths[:-1], lengths[-1] - 1], streams[:-2])
    for forged in (more, fewer):
        with pytest.raises(DataError, match="escapes do not fit"):
            one.decode(forged)


@pytest.mark.parametrize("name", COMPRESSED[3:])
def test_an_escape_for_every_pixel_and_none_at_all_stay_within_the_image(name: str) -> None:
    one = codec_by_name(name)
    height, width = 37, 50  # neither fills its last bytes, where codes stand for no pixel
    masks, codes = -(-height // 8) * width, height * -(-width // 4)
    header = struct.pack("<BBHH", 2, 0, height, width)
    table = [1] if COUNTS[name] == 2 else []
    for escapes in (0, 1, height * width):
        forged = bytes(2 * len(table)) + b"\xff" * (masks + codes) + bytes(2 * escapes)
        with pytest.raises(DataError, match="do not fit"):
            one.decode(joined(header, [*table, escapes], forged))


def test_disparity_that_adds_up_beyond_11_bits_is_refused() -> None:
    one = codec_by_name("disparity-lossless")
    header, lengths, streams = parts(one, one.encode(np.full((1, 1), 2046, np.uint16)))
    mask, code, low, high = streams
    assert lengths == [1]
    with pytest.raises(DataError, match="11 bits"):
        one.decode(joined(header, lengths, bytes([mask, code, low, high + 1])))


def test_depth_outside_of_its_table_is_refused() -> None:
    one = codec_by_name("depth-lossless")
    header, lengths, streams = parts(one, one.encode(np.full((1, 1), 700, np.uint16)))
    assert lengths == [2, 0]  # no measurement, and 700; the pixel's place 1 needs no escape
    with pytest.raises(DataError, match="table"):
        one.decode(joined(header, [1, 0], streams[:2] + streams[4:]))
    with pytest.raises(DataError):
        one.decode(joined(header, [0, 0], streams[4:]))
