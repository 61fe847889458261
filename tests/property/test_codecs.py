"""Codecs against any image and any bytes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig_protocol.codecs import COLOR_CODECS, DEPTH_CODECS, Codec, codec
from rig_protocol.errors import DataError
from support.images import Image, empty_of, largest_value, scene

ALL = [codec(codec_id) for codec_id in COLOR_CODECS + DEPTH_CODECS]

every_codec = pytest.mark.parametrize("one", ALL, ids=[one.name for one in ALL])
every_lossless_codec = pytest.mark.parametrize(
    "one", [one for one in ALL if one.lossless], ids=[one.name for one in ALL if one.lossless]
)

# Deadlines off: the first example loads the compiled decoders.
quick = settings(deadline=None, max_examples=40)


@st.composite
def images(draw: st.DrawFn, one: Codec) -> Image:
    """Few values or many, in runs or scattered."""
    height, width = draw(st.integers(1, 70)), draw(st.integers(1, 70))
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    image = empty_of(one.image, height, width)
    palette = draw(st.lists(st.integers(0, largest_value(one.image)), min_size=1, max_size=6))
    choices = generator.choice(np.array(palette), image.shape)
    if draw(st.booleans()):
        choices = np.sort(choices, axis=draw(st.integers(0, 1)))
    jitter = generator.integers(-draw(st.integers(0, 3)), 4, image.shape)
    return (choices + jitter).clip(0, largest_value(one.image)).astype(image.dtype)


@every_lossless_codec
@quick
@given(data=st.data())
def test_every_pixel_of_any_image_survives(one: Codec, data: st.DataObject) -> None:
    image = data.draw(images(one))
    decoded = one.decode(one.encode(image))
    assert decoded.dtype == image.dtype
    np.testing.assert_array_equal(decoded, image)


@every_codec
@quick
@given(data=st.data())
def test_a_damaged_payload_is_a_data_error_or_an_image_of_its_kind(one: Codec, data: st.DataObject) -> None:
    payload = bytearray(one.encode(scene(one.image, 37, 50)))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    del payload[data.draw(st.integers(len(payload) // 2, 2 * len(payload))) :]
    assert_data_error_or_image(one, bytes(payload))


@every_codec
@quick
@given(body=st.binary(max_size=200))
def test_any_bytes_behind_a_header_are_a_data_error_or_an_image(one: Codec, body: bytes) -> None:
    assert_data_error_or_image(one, b"\2\0\5\0\4\0" + body)


@every_codec
@quick
@given(data=st.binary(max_size=100))
def test_any_bytes_are_a_data_error_or_an_image(one: Codec, data: bytes) -> None:
    assert_data_error_or_image(one, data)


def assert_data_error_or_image(one: Codec, data: bytes) -> None:
    try:
        decoded = one.decode(data)
    except DataError:
        return
    again = one.decode(one.encode(decoded))  # an image that the codec itself accepts
    assert again.shape == decoded.shape
