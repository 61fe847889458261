"""Lossless colour: Bayer, BGR and grey images as pyramids of residuals (layout in CODECS.md)."""

from collections.abc import Iterator
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
        green = residuals.plane(np.zeros((rows // 2, columns // 2), np.int16))
        other_green, at_red, at_blue = residuals.greens(green)
        red, blue = residuals.plane(at_red) + at_red, residuals.plane(at_blue) + at_blue
        residuals.check_spent()
        mosaic = np.empty((rows, columns), np.uint8)
        mosaic[0::2] = _alternate(green, red)
        mosaic[1::2] = _alternate(blue, other_green)
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
        plane = residuals.plane(np.zeros((rows, columns), np.int16))
        residuals.check_spent()
        return plane[:height, :width].astype(np.uint8)


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
        green = residuals.plane(np.zeros((rows, columns), np.int16))
        blue, red = residuals.plane(green) + green, residuals.plane(green) + green
        residuals.check_spent()
        return np.stack([plane[:height, :width].astype(np.uint8) for plane in (blue, green, red)], axis=2)


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


def _alternate(even: Plane, odd: Plane) -> ImageU8:
    """Rows whose even columns come from one plane and whose odd ones from the other."""
    pairs = cv2.merge([even.astype(np.uint8), odd.astype(np.uint8)])
    return np.asarray(pairs, np.uint8).reshape(even.shape[0], 2 * even.shape[1])


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

    def plane(self, reference: Plane) -> Plane:
        """The next plane's differences to `reference`."""
        plane: Plane = decoding_kernels().restore_plane(reference, self.symbols, self.cursors)
        return plane

    def greens(self, green: Plane) -> Plane:
        """The next step of a mosaic: its other green grid, green where red and where blue is (3, H, W)."""
        greens: Plane = decoding_kernels().restore_greens(green, self.symbols, self.cursors)
        return greens

    def check_spent(self) -> None:
        """DataError unless decoding took each context's residuals to their end."""
        if not np.array_equal(self.cursors, self._ends):
            raise DataError("residuals do not fit the image that they make")
