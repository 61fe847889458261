"""Lossless colour: Bayer, BGR and grey images as pyramids of residuals (layout in CODECS.md)."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from rig_protocol.codecs import pyramid
from rig_protocol.codecs.base import (
    Bytes,
    Image,
    check_image,
    compress,
    decoding_kernels,
    decompress,
    pack_header,
    unpack_header,
)
from rig_protocol.codecs.pyramid import BLOCK, MIDDLE
from rig_protocol.frames import ImageU8


@dataclass(frozen=True, slots=True)
class BayerCodec:
    """GRBG mosaic: one green grid from the other, red and blue as differences to the green around them."""

    id: int
    name: str = "bayer-lossless"
    image: Literal["bayer"] = "bayer"
    lossless: bool = True

    def encode(self, image: Image) -> bytes:
        """About half the pixels' bytes, where the noise is a real one."""
        check_image(image, self.image)
        mosaic = pyramid.pad(image, 2 * BLOCK)
        green, red, blue, green_centres = pyramid.quarters(mosaic[np.newaxis])
        at_centres, at_red, at_blue = pyramid.predictions(green, green_centres)
        planes = np.concatenate([green, red - at_red + MIDDLE, blue - at_blue + MIDDLE])
        streams = [*pyramid.residuals(planes), (green_centres - at_centres).ravel()]
        return pack_header(image) + compress(streams)

    def decode(self, data: Bytes) -> Image:
        """Needs Numba."""
        height, width, body = unpack_header(data)
        rows, columns = pyramid.padded_shape(height, width, 2 * BLOCK)
        residuals = decompress(body, rows * columns)
        mosaic = np.empty((rows, columns), np.uint8)
        decoding_kernels().restore_mosaic(residuals, mosaic)
        return np.ascontiguousarray(mosaic[:height, :width])


@dataclass(frozen=True, slots=True)
class GreyCodec:
    """One pyramid."""

    id: int
    name: str = "grey-lossless"
    image: Literal["grey"] = "grey"
    lossless: bool = True

    def encode(self, image: Image) -> bytes:
        """The pyramid's residuals."""
        check_image(image, self.image)
        planes = pyramid.pad(image, BLOCK)[np.newaxis]
        return pack_header(image) + compress(list(pyramid.residuals(planes)))

    def decode(self, data: Bytes) -> Image:
        """Needs Numba."""
        height, width, body = unpack_header(data)
        (grey,) = _restore_planes(body, 1, height, width)
        return np.ascontiguousarray(grey[:height, :width])


@dataclass(frozen=True, slots=True)
class BgrCodec:
    """Three pyramids: green, blue minus green, red minus green."""

    id: int
    name: str = "bgr-lossless"
    image: Literal["bgr"] = "bgr"
    lossless: bool = True

    def encode(self, image: Image) -> bytes:
        """The pyramids' residuals."""
        check_image(image, self.image)
        blue, green, red = cv2.split(pyramid.pad(image, BLOCK))
        planes = np.stack([green, blue - green + MIDDLE, red - green + MIDDLE])
        return pack_header(image) + compress(list(pyramid.residuals(planes)))

    def decode(self, data: Bytes) -> Image:
        """Needs Numba."""
        height, width, body = unpack_header(data)
        green, blue, red = _restore_planes(body, 3, height, width)
        for difference in (blue, red):
            difference += green
            difference -= MIDDLE
        channels = [plane[:height, :width] for plane in (blue, green, red)]
        return np.asarray(cv2.merge(channels), np.uint8)


def _restore_planes(body: memoryview, count: int, height: int, width: int) -> ImageU8:
    """The planes (count, H, W) of a body, padded to whole blocks."""
    rows, columns = pyramid.padded_shape(height, width, BLOCK)
    residuals = decompress(body, count * rows * columns).reshape(count, -1)
    planes = np.empty((count, rows, columns), np.uint8)
    decoding_kernels().restore_planes(residuals, planes)
    return planes
