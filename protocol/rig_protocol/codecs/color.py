"""Lossless colour: Bayer, BGR and grey images as pyramids of residuals (layout in CODECS.md)."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rig_protocol.codecs import pyramid
from rig_protocol.codecs.base import (
    Bytes,
    Image,
    check_image,
    compress,
    decoding_kernels,
    decompress,
    pack_counts,
    pack_header,
    unpack_counts,
    unpack_header,
)
from rig_protocol.codecs.pyramid import BLOCK, CONTEXTS, Plane, Step
from rig_protocol.errors import DataError
from rig_protocol.frames import ImageU8

_HASH_LOG = 6


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
        return _pack(image, _mosaic_steps(pyramid.pad(image, 2 * BLOCK)))

    def decode(self, data: Bytes) -> Image:
        """Needs Numba."""
        height, width, body = unpack_header(data)
        rows, columns = pyramid.padded_shape(height, width, 2 * BLOCK)
        residuals = _Residuals(body, rows * columns)
        mosaic = np.empty((rows, columns), np.uint8)
        residuals.plane(np.zeros((rows // 2, columns // 2), np.int16), mosaic[0::2, 0::2])
        green_at_red, green_at_blue = residuals.greens(mosaic)
        residuals.plane(green_at_red, mosaic[0::2, 1::2])
        residuals.plane(green_at_blue, mosaic[1::2, 0::2])
        residuals.check_spent()
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
        plane = pyramid.pad(image, BLOCK).astype(np.int16)
        return _pack(image, pyramid.plane_steps(plane))

    def decode(self, data: Bytes) -> Image:
        """Needs Numba."""
        height, width, body = unpack_header(data)
        rows, columns = pyramid.padded_shape(height, width, BLOCK)
        residuals = _Residuals(body, rows * columns)
        image = np.empty((rows, columns), np.uint8)
        residuals.plane(np.zeros((rows, columns), np.int16), image)
        residuals.check_spent()
        return np.ascontiguousarray(image[:height, :width])


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
        return _pack(image, _bgr_steps(pyramid.pad(image, BLOCK)))

    def decode(self, data: Bytes) -> Image:
        """Needs Numba."""
        height, width, body = unpack_header(data)
        rows, columns = pyramid.padded_shape(height, width, BLOCK)
        residuals = _Residuals(body, 3 * rows * columns)
        image = np.empty((rows, columns, 3), np.uint8)
        residuals.plane(np.zeros((rows, columns), np.int16), image[..., 1])
        green = image[..., 1].astype(np.int16)
        residuals.plane(green, image[..., 0])
        residuals.plane(green, image[..., 2])
        residuals.check_spent()
        return np.ascontiguousarray(image[:height, :width])


def _mosaic_steps(mosaic: ImageU8) -> Iterator[Step]:
    green, red, blue, green_centres = pyramid.quarters(mosaic)
    yield from pyramid.plane_steps(green)
    yield pyramid.step(green_centres, pyramid.diagonal(green))
    green_at_red, _ = pyramid.cross_columns(green, green_centres)
    yield from pyramid.plane_steps(red - green_at_red)
    green_at_blue, _ = pyramid.cross_rows(green, green_centres)
    yield from pyramid.plane_steps(blue - green_at_blue)


def _bgr_steps(image: ImageU8) -> Iterator[Step]:
    blue, green, red = (image[..., channel].astype(np.int16) for channel in range(3))
    for plane in (green, blue - green, red - green):
        yield from pyramid.plane_steps(plane)


def _pack(image: ImageU8, steps: Iterator[Step]) -> bytes:
    streams = pyramid.sort_residuals(list(steps))
    lengths = pack_counts(*(stream.size for stream in streams))
    return b"".join([pack_header(image), lengths, compress(streams, _HASH_LOG)])


class _Residuals:
    """The residuals of a payload: one array, and a cursor into it for each context."""

    def __init__(self, body: memoryview, pixels: int) -> None:
        """DataError unless the payload holds exactly one residual a pixel."""
        lengths, compressed = unpack_counts(body, CONTEXTS, pixels)
        if sum(lengths) != pixels:
            raise DataError(f"{sum(lengths)} residuals for {pixels} pixels")
        self.symbols = decompress(compressed, pixels)
        self._ends = np.cumsum(lengths)
        self.cursors = self._ends - lengths

    def plane(self, reference: Plane, pixels: ImageU8) -> None:
        """Fill the pixels of the next plane, coded as differences to `reference`."""
        decoding_kernels().restore_plane(reference, self.symbols, self.cursors, pixels)

    def greens(self, mosaic: ImageU8) -> Plane:
        """Fill the other green grid, a mosaic's next step; green where red and where blue is (2, H, W)."""
        greens: Plane = decoding_kernels().restore_greens(mosaic, self.symbols, self.cursors)
        return greens

    def check_spent(self) -> None:
        """DataError unless decoding took each context's residuals to their end."""
        if not np.array_equal(self.cursors, self._ends):
            raise DataError("residuals do not fit the image that they make")
