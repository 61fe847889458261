"""The payloads of codec layout 2, pinned: whatever encoder wrote them, every decoder reads them."""

import base64
import json
from pathlib import Path

import numpy as np
import pytest

from rig_protocol.codecs import COLOR_CODECS, DEPTH_CODECS, codec, codec_by_name
from support.images import Image, empty_of

PAYLOADS = json.loads((Path(__file__).parent / "codecs_v2.json").read_text())


def pinned_image(name: str) -> Image:
    """A formula, not a generator's numbers: other implementations can write it down."""
    image = empty_of(codec_by_name(name).image, 36, 41)
    y, x, channel = np.mgrid[:36, :41, :3]
    values = 40 + x + 2 * y + 7 * channel + (x * y) % 5 + 50 * (x > 20)
    if image.dtype == np.uint16:
        values = np.where((x + y) % 11 < 2, 2047 if "disparity" in name else 0, 4 * values)
    return (values if image.ndim == 3 else values[..., 0]).astype(image.dtype)


@pytest.mark.parametrize("name", PAYLOADS)
def test_a_pinned_payload_is_read(name: str) -> None:
    one = codec_by_name(name)
    decoded = one.decode(base64.b64decode(PAYLOADS[name]))
    if one.lossless:
        np.testing.assert_array_equal(decoded, pinned_image(name))
    else:
        assert np.abs(decoded.astype(int) - pinned_image(name)).mean() < 4


def test_every_codec_is_pinned() -> None:
    assert set(PAYLOADS) == {codec(codec_id).name for codec_id in COLOR_CODECS + DEPTH_CODECS}
