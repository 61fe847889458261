"""Disparity as the sensor packs it, and unpacked."""

import numpy as np

from rig_agent.sources.freenect_formats import COLOR, DEPTH, HIGH_COLOR, unpack_11bit
from support.virtual_usb.virtual_bus import pack_bits


def test_unpacking_gives_back_every_value_at_every_place_of_a_group() -> None:
    pixels = np.arange(480 * 640, dtype=np.uint32) * 1031 % 2048  # 1031 is odd: every value, in every column
    raw = pixels.astype(np.uint16).reshape(480, 640)
    assert all(len(np.unique(raw.reshape(-1, 8)[:, place])) == 2048 // 8 for place in range(8))
    raw[100:, :] = np.random.default_rng(0).integers(0, 2048, (380, 640))
    packed = np.frombuffer(pack_bits(raw, bits=11), np.uint8)
    np.testing.assert_array_equal(unpack_11bit(packed), raw)


def test_sizes_are_those_of_libfreenects_header() -> None:
    assert {name: form.bytes for name, form in COLOR.items()} == {
        "bayer": 307_200,
        "rgb": 921_600,
        "ir": 312_320,
    }
    assert {name: form.bytes for name, form in DEPTH.items()} == {"11bit": 614_400, "11bit_packed": 422_400}
    assert HIGH_COLOR["bayer"].bytes == 1_310_720
