"""Lossless depth: disparity and millimetres as steps down the columns (layout in CODECS.md).

On real frames 96 % of a Kinect's valid pixels differ from the one above by at most one step, so that two
bits say it. The few larger steps are kept apart, and a mask of one bit a pixel says where there is a
measurement. Steps go down so that a decoder adds up a whole row at once. The encoder works on the
transposed image, where what is below each other comes one after another.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

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

_VALUES = 1 << 16
_ESCAPE = 3


@dataclass(frozen=True, slots=True)
class DisparityCodec:
    """Raw 11-bit disparity."""

    id: int
    name: str = "disparity-lossless"
    image: Literal["raw"] = "raw"
    lossless: bool = True

    def encode(self, image: Image) -> bytes:
        """About a sixteenth of the pixels' bytes, where the scene is a real one."""
        check_image(image, self.image)
        mask, codes, escapes = _surface_streams(image, NO_DISPARITY)
        counts = pack_counts(escapes.size // 2)
        return b"".join([pack_header(image), counts, compress([mask, codes, escapes])])

    def decode(self, data: Bytes) -> Image:
        """Needs Numba."""
        height, width, body = unpack_header(data)
        (escapes,), compressed = unpack_counts(body, 1, height * width)
        layout = _Layout(height, width, escapes)
        image, largest = _restore(layout, decompress(compressed, layout.size), NO_DISPARITY)
        if largest > NO_DISPARITY:
            raise DataError(f"raw disparity has 11 bits, found {largest}")
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
        mask, codes, escapes = _surface_streams(np.take(place, image), 0)
        counts = pack_counts(values.size // 2, escapes.size // 2)
        return b"".join([pack_header(image), counts, compress([values, mask, codes, escapes])])

    def decode(self, data: Bytes) -> Image:
        """Needs Numba."""
        height, width, body = unpack_header(data)
        (values, escapes), compressed = unpack_counts(body, 2, max(height * width, _VALUES))
        if values > _VALUES:
            raise DataError(f"{values} different 16-bit values")
        layout = _Layout(height, width, escapes)
        streams = decompress(compressed, 2 * values + layout.size)
        table = np.frombuffer(streams[: 2 * values], "<u2").astype(np.uint16)
        places, largest = _restore(layout, streams[2 * values :], 0)
        if largest >= values:
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
        return -(-self.height // 8), self.width

    @property
    def codes_shape(self) -> tuple[int, int]:
        return self.height, -(-self.width // 4)

    @property
    def size(self) -> int:
        mask, codes = self.mask_shape, self.codes_shape
        return mask[0] * mask[1] + codes[0] * codes[1] + 2 * self.escapes


def _surface_streams(image: ImageU16, none: int) -> tuple[ImageU8, ImageU8, ImageU8]:
    """Mask, codes and escapes (low bytes, high bytes) of a surface."""
    # Above the image stands a row of measured zeros, from which the first of each column steps.
    columns = cv2.transpose(cv2.copyMakeBorder(image, 1, 0, 0, 0, cv2.BORDER_CONSTANT, value=0))
    valid = columns != none
    valid[:, 0] = True
    steps = np.diff(columns[valid], prepend=np.uint16(0)).view(np.int16)
    zigzag = np.zeros(columns.shape, np.uint16)
    zigzag[valid] = ((steps << 1) ^ (steps >> 15)).view(np.uint16)
    zigzag = np.asarray(cv2.transpose(zigzag), np.uint16)[1:]
    escapes = zigzag[zigzag >= _ESCAPE] - _ESCAPE
    mask = np.asarray(cv2.transpose(np.packbits(valid[:, 1:], axis=1, bitorder="little")), np.uint8)
    return mask, _pack_codes(zigzag), np.concatenate([escapes & 255, escapes >> 8]).astype(np.uint8)


def _pack_codes(zigzag: ImageU16) -> ImageU8:
    """2-bit codes, 3 where there is an escape; four columns of one row in a byte."""
    height, width = zigzag.shape
    codes = np.zeros((height, -(-width // 4) * 4), np.uint8)
    limits = np.full(width, _ESCAPE, np.uint16)  # a row: NumPy's vector loop takes no single number
    codes[:, :width] = np.minimum(zigzag, limits)
    words = codes.view("<u4")
    packed: ImageU8 = (words | words >> 6 | words >> 12 | words >> 18).astype(np.uint8)
    return packed


def _restore(layout: _Layout, streams: ImageU8, none: int) -> tuple[ImageU16, int]:
    """The surface of its streams and its largest value; DataError when the escapes do not fit the codes."""
    masked = layout.mask_shape[0] * layout.mask_shape[1]
    coded = streams.size - 2 * layout.escapes
    mask = streams[:masked].reshape(layout.mask_shape)
    codes = streams[masked:coded].reshape(layout.codes_shape)
    escapes = streams[coded:].reshape(2, layout.escapes)
    surface = np.empty((layout.height, layout.width), np.uint16)
    used, largest = decoding_kernels().restore_surface(mask, codes, escapes, none, surface)
    if used != layout.escapes:
        raise DataError("escapes do not fit the surface that they make")
    return surface, largest
