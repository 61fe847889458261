"""Lossless depth: disparity and millimetres as residuals along the row (layout in CODECS.md).

On real frames 98 % of a Kinect's valid pixels differ from the one before by at most one step, so that
two bits say it. A byte holds four pixels of one column: what lies above each other jumps together. The
few larger steps are kept apart, and a mask of one bit a pixel says where there is a measurement.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

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
from rig_protocol.errors import DataError
from rig_protocol.frames import NO_DEPTH_MM, NO_DISPARITY, ImageU8, ImageU16

_HASH_LOG = 12
_VALUES = 1 << 16


@dataclass(frozen=True, slots=True)
class DisparityCodec:
    """Raw 11-bit disparity."""

    id: int
    name: str = "disparity-lossless"
    image: Literal["raw"] = "raw"
    lossless: bool = True

    def encode(self, image: Image) -> bytes:
        """About a twentieth of the pixels' bytes, where the scene is a real one."""
        check_image(image, self.image)
        streams = _surface_streams(image, NO_DISPARITY)
        return b"".join([pack_header(image), pack_counts(streams[-1].shape[1]), compress(streams, _HASH_LOG)])

    def decode(self, data: Bytes) -> Image:
        """Needs Numba."""
        height, width, body = unpack_header(data)
        (escapes,), compressed = unpack_counts(body, 1, height * width)
        layout = _Layout(height, width, escapes)
        image = _restore(layout, decompress(compressed, layout.size), NO_DISPARITY)
        if image.max() > NO_DISPARITY:
            raise DataError(f"raw disparity has 11 bits, found {image.max()}")
        return image


@dataclass(frozen=True, slots=True)
class MillimetreCodec:
    """Depth in millimetres: the list of values that occur, then each pixel's place in it.

    A sensor knows only some hundred distances, and far ones lie centimetres apart. Places in the list
    step by one where the disparity that they came from did, and cost as little.
    """

    id: int
    name: str = "depth-lossless"
    image: Literal["depth_mm"] = "depth_mm"
    lossless: bool = True

    def encode(self, image: Image) -> bytes:
        """Values, then the surface of places; place 0 is `no measurement`."""
        check_image(image, self.image)
        occurs = np.bincount(image.ravel(), minlength=_VALUES) > 0
        occurs[NO_DEPTH_MM] = True
        place = (np.cumsum(occurs) - 1).astype(np.uint16)
        values = np.flatnonzero(occurs).astype("<u2").view(np.uint8)
        streams = [values, *_surface_streams(np.take(place, image), 0)]
        counts = pack_counts(values.size // 2, streams[-1].shape[1])
        return b"".join([pack_header(image), counts, compress(streams, _HASH_LOG)])

    def decode(self, data: Bytes) -> Image:
        """Needs Numba."""
        height, width, body = unpack_header(data)
        (values, escapes), compressed = unpack_counts(body, 2, max(height * width, _VALUES))
        if values > _VALUES:
            raise DataError(f"{values} different 16-bit values")
        layout = _Layout(height, width, escapes)
        streams = decompress(compressed, 2 * values + layout.size)
        table = np.frombuffer(streams[: 2 * values], "<u2").astype(np.uint16)
        places = _restore(layout, streams[2 * values :], 0)
        if places.max() >= values:
            raise DataError("depth outside of its table of values")
        return np.take(table, places)


@dataclass(frozen=True, slots=True)
class _Layout:
    """Sizes of the streams of one surface."""

    height: int
    width: int
    escapes: int

    @property
    def mask_shape(self) -> tuple[int, int]:
        return self.height, -(-self.width // 8)

    @property
    def codes_shape(self) -> tuple[int, int]:
        return -(-self.height // 4), self.width

    @property
    def size(self) -> int:
        return int(np.prod(self.mask_shape) + np.prod(self.codes_shape)) + 2 * self.escapes


def _surface_streams(image: ImageU16, none: int) -> list[ImageU8]:
    """Mask, codes and escapes (low bytes, high bytes) of a surface."""
    valid = image != none
    steps = np.zeros(image.shape, np.int16)
    steps[valid] = _steps(image[valid], np.count_nonzero(valid, axis=1))
    zigzag = ((steps << 1) ^ (steps >> 15)).view(np.uint16)
    escapes = zigzag[zigzag >= 3] - 3
    mask = np.packbits(valid, axis=1, bitorder="little")
    return [mask, _pack_codes(zigzag), np.stack([escapes & 255, escapes >> 8]).astype(np.uint8)]


def _steps(values: ImageU16, row_counts: npt.NDArray[np.intp]) -> npt.NDArray[np.int16]:
    """Differences modulo 2¹⁶ of the valid pixels of all rows: to the one before in the row, and from
    the first of a row to the first of the last row that has any."""
    steps = np.diff(values, prepend=np.uint16(0))
    filled = row_counts[row_counts > 0]
    first = np.cumsum(filled) - filled
    steps[first] = np.diff(values[first], prepend=np.uint16(0))
    return steps.view(np.int16)


def _pack_codes(zigzag: ImageU16) -> ImageU8:
    """2-bit codes, 3 where there is an escape; four rows of one column in a byte."""
    height, width = zigzag.shape
    codes = np.zeros((-(-height // 4) * 4, width), np.uint8)
    np.minimum(zigzag, 3, out=codes[:height], casting="unsafe")
    packed: ImageU8 = codes[0::4] | codes[1::4] << 2 | codes[2::4] << 4 | codes[3::4] << 6
    return packed


def _restore(layout: _Layout, streams: ImageU8, none: int) -> ImageU16:
    """The surface of its streams; DataError when the escapes do not fit the codes."""
    masked = int(np.prod(layout.mask_shape))
    coded = masked + int(np.prod(layout.codes_shape))
    mask = streams[:masked].reshape(layout.mask_shape)
    codes = streams[masked:coded].reshape(layout.codes_shape)
    escapes = streams[coded:].reshape(2, layout.escapes)
    surface = np.empty((layout.height, layout.width), np.uint16)
    if decoding_kernels().restore_surface(mask, codes, escapes, none, surface) != layout.escapes:
        raise DataError("escapes do not fit the surface that they make")
    return surface
