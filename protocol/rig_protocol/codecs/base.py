"""What every codec is made of: the image header, bounds, and compression of byte streams.

A payload opens with `version u8 = 2, zero u8, height u16, width u16` (little-endian), see CODECS.md.
"""

import importlib
import struct
from collections import deque
from collections.abc import Sequence
from types import ModuleType
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt
import zstandard

from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import NO_DISPARITY

ImageKind = Literal["bayer", "bgr", "grey", "raw", "depth_mm"]
Image = npt.NDArray[Any]
Bytes = bytes | memoryview

VERSION = 2
MAX_SIDE = 4096
"""Longest image side in pixels: three times a Kinect's, and it bounds what a decoder allocates."""

_HEADER = struct.Struct("<BBHH")

_idle: deque[zstandard.ZstdDecompressor] = deque(maxlen=8)
"""Decompression contexts for reuse, some 100 KB each; more threads than this make their own."""


class Codec(Protocol):
    """One way to put one kind of image into bytes; stateless, any thread may use it."""

    @property
    def id(self) -> int:
        """Wire id, 1–255; never reused."""

    @property
    def name(self) -> str:
        """For people and tables."""

    @property
    def image(self) -> ImageKind:
        """The kind of image that `encode` takes and `decode` gives."""

    @property
    def lossless(self) -> bool:
        """True when every pixel survives."""

    def encode(self, image: Image) -> bytes:
        """The payload of an image; ValueError when the image is not of the codec's kind."""

    def decode(self, data: Bytes) -> Image:
        """The image of a payload; DataError for anything malformed, before it allocates what is stated."""


def check_image(image: Image, kind: ImageKind) -> None:
    """ValueError when an array is no image of this kind."""
    dtype = np.uint16 if kind in ("raw", "depth_mm") else np.uint8
    channels = (3,) if kind == "bgr" else ()
    if image.dtype != dtype or image.shape[2:] != channels or image.ndim != 2 + len(channels):
        raise ValueError(
            f"a {kind} image is {np.dtype(dtype)} (H, W{', 3' * bool(channels)}), "
            f"not {image.dtype} {image.shape}"
        )
    if not all(1 <= side <= MAX_SIDE for side in image.shape[:2]):
        raise ValueError(f"image sides go from 1 to {MAX_SIDE} pixels, not {image.shape[:2]}")
    if kind == "raw" and image.max() > NO_DISPARITY:
        raise ValueError(f"raw disparity has 11 bits, found {image.max()}")


def pack_header(image: Image) -> bytes:
    """The header that states an image's shape."""
    return _HEADER.pack(VERSION, 0, image.shape[0], image.shape[1])


def unpack_header(data: Bytes) -> tuple[int, int, memoryview]:
    """Height, width and what follows the header."""
    if len(data) < _HEADER.size:
        raise DataError(f"payload of {len(data)} bytes has no image header")
    version, zero, height, width = _HEADER.unpack_from(data)
    if version != VERSION or zero != 0:
        raise DataError(f"image header version {version}.{zero}: this program reads version {VERSION}.0")
    if not (1 <= height <= MAX_SIDE and 1 <= width <= MAX_SIDE):
        raise DataError(f"image of {width}×{height} pixels: sides go from 1 to {MAX_SIDE}")
    return height, width, memoryview(data)[_HEADER.size :]


def unpack_counts(body: memoryview, count: int, limit: int) -> tuple[list[int], memoryview]:
    """`count` u32 numbers that open a body, each at most `limit`, and the rest."""
    if len(body) < 4 * count:
        raise DataError("payload ends within its stream lengths")
    values = list(struct.unpack_from(f"<{count}I", body))
    if max(values) > limit:
        raise DataError(f"stream lengths {values} exceed the image")
    return values, body[4 * count :]


def pack_counts(*counts: int) -> bytes:
    """Stream lengths as u32."""
    return struct.pack(f"<{len(counts)}I", *counts)


def decoding_kernels() -> ModuleType:
    """The compiled decoding loops; ConfigurationError where Numba is not installed, as on an agent."""
    try:
        return importlib.import_module("rig_protocol.codecs.kernels")
    except ModuleNotFoundError as error:
        raise ConfigurationError(
            f"decoding lossless images needs {error.name}: install kinect-rig[server]"
        ) from error


def compress(streams: Sequence[npt.NDArray[np.uint8]]) -> bytes:
    """One zstd frame that holds the streams one after another, a fresh entropy table for each.

    Residuals are noise: a small hash table and long matches leave them to the entropy coder, which
    packs them tighter than chance matches do. Contexts are made per call: they cost a few
    microseconds and must not be shared among threads.
    """
    size = sum(stream.size for stream in streams)
    parameters = zstandard.ZstdCompressionParameters.from_level(1, source_size=size, hash_log=6, min_match=7)
    compressor = zstandard.ZstdCompressor(compression_params=parameters).compressobj(size=size)
    chunks = []
    for stream in streams:
        chunks += [compressor.compress(stream.data), compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)]
    return b"".join([*chunks, compressor.flush()])


def decompress(body: memoryview, size: int) -> npt.NDArray[np.uint8]:
    """The bytes of one zstd frame that states and holds exactly `size` of them; DataError otherwise."""
    try:
        if zstandard.frame_content_size(body) != size:
            raise DataError(f"compressed streams do not hold the {size} bytes that the image needs")
        data = _decompress(body)
    except zstandard.ZstdError as error:
        raise DataError(f"compressed streams are damaged: {error}") from error
    return np.frombuffer(data, np.uint8)


def _decompress(body: memoryview) -> bytes:
    """With a context that no other thread uses meanwhile; a new one would take a tenth as long again."""
    try:
        context = _idle.pop()
    except IndexError:
        context = zstandard.ZstdDecompressor()
    try:
        return context.decompress(body, allow_extra_data=False)
    finally:
        _idle.append(context)
