"""Rules that hold for every codec of the registry."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig_protocol import codecs
from rig_protocol.codecs import COLOR_CODECS, DEPTH_CODECS, Codec, base, codec, codec_by_name, codecs_for
from rig_protocol.errors import ConfigurationError, DataError
from support.images import empty_of, largest_value, mosaic, noise, read_image, scene
from support.real_data import real_data

ALL = [codec(codec_id) for codec_id in COLOR_CODECS + DEPTH_CODECS]
LOSSLESS = [one for one in ALL if one.lossless]

SHAPES = [(480, 640), (488, 640), (1, 4096), (1, 1), (1, 7), (9, 1), (2, 2), (31, 33), (97, 130)]

every_codec = pytest.mark.parametrize("one", ALL, ids=lambda one: one.name)
every_lossless_codec = pytest.mark.parametrize("one", LOSSLESS, ids=lambda one: one.name)


def test_wire_ids_never_change() -> None:
    assert {one.name: one.id for one in ALL} == {
        "bayer-lossless": 1,
        "bgr-lossless": 2,
        "grey-lossless": 3,
        "bgr-jpeg": 8,
        "grey-jpeg": 9,
        "bayer-uncompressed": 16,
        "bgr-uncompressed": 17,
        "grey-uncompressed": 18,
        "disparity-lossless": 32,
        "depth-lossless": 33,
        "disparity-uncompressed": 48,
        "depth-uncompressed": 49,
    }


@every_codec
def test_a_codec_is_found_by_id_and_by_name(one: Codec) -> None:
    assert codec(one.id) is one
    assert codec_by_name(one.name) is one


def test_an_unknown_codec_is_a_data_error() -> None:
    with pytest.raises(DataError, match="codec 255 is unknown"):
        codec(255)
    with pytest.raises(DataError, match="none of bayer-lossless"):
        codec_by_name("bayer-magic")


@pytest.mark.parametrize("kind", ["bayer", "bgr", "grey", "raw", "depth_mm"])
def test_lossless_codecs_come_first_and_uncompressed_ones_last(kind: base.ImageKind) -> None:
    names = [codec(codec_id).name for codec_id in codecs_for(kind)]
    order = ["lossless", "jpeg", "uncompressed"]
    assert [order.index(name.split("-")[1]) for name in names] in ([0, 2], [0, 1, 2])


@every_lossless_codec
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_every_pixel_of_a_scene_survives(one: Codec, shape: tuple[int, int]) -> None:
    image = scene(one.image, *shape)
    assert_same(one.decode(one.encode(image)), image)


@every_lossless_codec
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_every_pixel_of_noise_survives(one: Codec, shape: tuple[int, int]) -> None:
    image = noise(one.image, *shape)
    assert_same(one.decode(one.encode(image)), image)


@every_lossless_codec
def test_extreme_images_survive(one: Codec) -> None:
    flat = empty_of(one.image, 33, 40)
    full = np.full_like(flat, largest_value(one.image))
    checkered = flat.copy()
    checkered[::2, ::2] = checkered[1::2, 1::2] = largest_value(one.image)
    striped = flat.copy()
    striped[:, 1::3] = largest_value(one.image)
    for image in (flat, full, checkered, striped, striped[::-1, ::-1]):
        assert_same(one.decode(one.encode(image)), image)


@every_lossless_codec
def test_a_high_resolution_image_survives(one: Codec) -> None:
    image = scene(one.image, 1024, 1280)
    assert_same(one.decode(one.encode(image)), image)


@every_codec
def test_a_decoded_image_may_be_written_to(one: Codec) -> None:
    image = one.decode(one.encode(scene(one.image, 48, 64)))
    assert image.flags.writeable
    assert image.flags.c_contiguous


@every_codec
def test_a_payload_opens_with_version_and_image_size(one: Codec) -> None:
    data = one.encode(scene(one.image, 0x0102 // 2, 0x0304 // 2))
    assert data[:6] == bytes([2, 0, 0x81, 0x00, 0x82, 0x01])


@every_codec
def test_an_image_of_another_kind_is_refused(one: Codec) -> None:
    wrong_type = scene(one.image, 32, 32).astype(np.float32)
    wrong_shape = np.zeros((32, 32, 2), wrong_type.dtype)
    too_large = empty_of(one.image, 1, 4097)
    for image in (wrong_type, wrong_shape, too_large, empty_of(one.image, 0, 4)):
        with pytest.raises(ValueError, match="image"):
            one.encode(image)


@pytest.mark.parametrize("name", ["disparity-lossless", "disparity-uncompressed"])
def test_disparity_of_more_than_11_bits_is_not_encoded(name: str) -> None:
    with pytest.raises(ValueError, match="11 bits"):
        codec_by_name(name).encode(np.full((4, 4), 2048, np.uint16))


def test_disparity_of_more_than_11_bits_is_not_decoded() -> None:
    forged = codec_by_name("depth-uncompressed").encode(np.full((4, 4), 2048, np.uint16))
    with pytest.raises(DataError, match="11 bits"):
        codec_by_name("disparity-uncompressed").decode(forged)


@every_codec
def test_a_payload_cut_anywhere_is_a_data_error(one: Codec) -> None:
    data = one.encode(scene(one.image, 40, 48))
    for length in {0, 3, 5, 6, 8, 12, 21, 22, 23, len(data) // 2}:
        with pytest.raises(DataError):
            one.decode(data[:length])


@every_lossless_codec
def test_bytes_behind_the_payload_are_a_data_error(one: Codec) -> None:
    with pytest.raises(DataError):
        one.decode(one.encode(scene(one.image, 40, 48)) + b"\0")


@every_codec
@pytest.mark.parametrize(
    "header", [b"\1\0\x10\0\x10\0", b"\2\1\x10\0\x10\0", b"\2\0\0\0\x10\0", b"\2\0\1\x10\1\0"]
)
def test_an_impossible_header_is_a_data_error(one: Codec, header: bytes) -> None:
    with pytest.raises(DataError):
        one.decode(header + one.encode(scene(one.image, 16, 16))[6:])


@every_codec
def test_a_size_that_the_bytes_do_not_fill_is_a_data_error(one: Codec) -> None:
    data = one.encode(scene(one.image, 64, 64))
    with pytest.raises(DataError):
        one.decode(data[:2] + b"\x80\x00\x80\x00" + data[6:])


def test_encoding_needs_no_numba() -> None:
    names = [one.name for one in ALL]
    program = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parents[3])!r})
from rig_protocol.codecs import codec_by_name
from support.images import scene
for name in {names}:
    one = codec_by_name(name)
    one.encode(scene(one.image, 48, 64))
assert "numba" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", program], check=True)


def test_decoding_without_numba_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    data = codec_by_name("bayer-lossless").encode(scene("bayer", 32, 32))
    monkeypatch.delitem(sys.modules, "rig_protocol.codecs.kernels", raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(ConfigurationError, match=r"numba.*kinect-rig\[server\]"):
        codec_by_name("bayer-lossless").decode(data)


@every_lossless_codec
def test_threads_decode_at_the_same_time(one: Codec) -> None:
    images = [scene(one.image, 200, 300, seed) for seed in range(12)]
    payloads = [one.encode(image) for image in images]
    with ThreadPoolExecutor(4) as threads:
        for decoded, image in zip(threads.map(one.decode, payloads), images, strict=True):
            assert_same(decoded, image)


def test_warming_up_loads_the_decoders() -> None:
    codecs.warm_up()
    assert "rig_protocol.codecs.kernels" in sys.modules


def test_jpeg_stays_close_to_the_image() -> None:
    for name in ("bgr-jpeg", "grey-jpeg"):
        one = codec_by_name(name)
        image = cv2.GaussianBlur(scene(one.image, 480, 640), (0, 0), 2)
        decoded = one.decode(one.encode(image))
        assert np.abs(decoded.astype(int) - image).mean() < 1.0


def test_a_jpeg_of_another_size_than_the_header_says_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    one = codec_by_name("bgr-jpeg")
    small, large = one.encode(scene("bgr", 16, 16)), one.encode(scene("bgr", 480, 640))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    for forged in (small[:6] + large[6:], codec_by_name("grey-jpeg").encode(scene("grey", 16, 16))):
        with pytest.raises(DataError, match="does not hold a JPEG"):
            one.decode(forged)


def test_real_disparity_takes_at_most_56_kib() -> None:
    folder, one = real_data("kinect_v1_raw"), codec_by_name("disparity-lossless")
    images = [read_image(path) for path in sorted(folder.glob("*raw*.png"))]
    payloads = [one.encode(image) for image in images]
    assert all(np.array_equal(one.decode(data), image) for data, image in zip(payloads, images, strict=True))
    assert np.mean([len(data) for data in payloads]) <= 56 * 1024


def test_real_bayer_takes_at_most_182_kib() -> None:
    one = codec_by_name("bayer-lossless")
    views = sorted(real_data("tum_fr1_rpy_12views").glob("cam*/color_*.png"))
    for group in (views, [real_data("kinect_v1_raw") / "pair_color.png"]):
        images = [mosaic(read_image(path)) for path in group]
        payloads = [one.encode(image) for image in images]
        assert all(
            np.array_equal(one.decode(data), image) for data, image in zip(payloads, images, strict=True)
        )
        assert np.mean([len(data) for data in payloads]) <= 182 * 1024


def assert_same(decoded: np.ndarray, image: np.ndarray) -> None:
    assert decoded.dtype == image.dtype
    np.testing.assert_array_equal(decoded, image)
