"""What others would send depth and Bayer images as, for comparison with the project's codecs."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import zstandard

from rig_protocol.codecs import ImageKind

Image = np.ndarray[Any, np.dtype[Any]]


@dataclass(frozen=True)
class Peer:
    """A way to put an image into bytes; `decode` is told the image's shape and type."""

    name: str
    images: tuple[ImageKind, ...]
    encode: Callable[[Image], bytes]
    decode: Callable[[bytes, Image], Image]
    lossless: bool = True


def _zstd(data: bytes) -> bytes:
    return zstandard.ZstdCompressor(level=1).compress(data)


def _unzstd(data: bytes, dtype: object = np.uint8) -> Image:
    return np.frombuffer(zstandard.ZstdDecompressor().decompress(data), dtype)  # type: ignore[call-overload]  # any


def _encode_disparity_steps(image: Image) -> bytes:
    """Steps along the row as zigzag, low bytes and high bytes apart."""
    steps = np.diff(image, axis=1, prepend=np.uint16(0)).view(np.int16)
    zigzag = ((steps << 1) ^ (steps >> 15)).view(np.uint16)
    return _zstd(np.stack([zigzag & 255, zigzag >> 8]).astype(np.uint8).tobytes())


def _decode_disparity_steps(data: bytes, like: Image) -> Image:
    low, high = _unzstd(data).reshape(2, *like.shape).astype(np.uint16)
    zigzag = low | high << 8
    return np.cumsum((zigzag >> 1) ^ -(zigzag & 1), axis=1, dtype=np.uint16)


def _encode_bayer_steps(image: Image) -> bytes:
    """Steps along the rows of the four colour planes."""
    planes = np.stack([image[y::2, x::2] for y in (0, 1) for x in (0, 1)])
    return _zstd(np.diff(planes, axis=2, prepend=np.uint8(0)).tobytes())


def _decode_bayer_steps(data: bytes, like: Image) -> Image:
    height, width = like.shape
    planes = np.cumsum(_unzstd(data).reshape(4, height // 2, width // 2), axis=2, dtype=np.uint8)
    image = np.empty_like(like)
    for index, plane in enumerate(planes):
        image[index // 2 :: 2, index % 2 :: 2] = plane
    return image


def _encode_png(image: Image) -> bytes:
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def _decode_png(data: bytes, _: Image) -> Image:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


PEERS = (
    Peer(
        "zstd level 1",
        ("raw", "bayer"),
        lambda image: _zstd(image.tobytes()),
        lambda data, like: _unzstd(data, like.dtype).reshape(like.shape),
    ),
    Peer("steps + zstd level 1", ("raw",), _encode_disparity_steps, _decode_disparity_steps),
    Peer("steps + zstd level 1", ("bayer",), _encode_bayer_steps, _decode_bayer_steps),
    Peer("PNG level 1 (OpenCV)", ("raw", "bayer"), _encode_png, _decode_png),
)
"""JPEG XL and JPEG-LS would be here if a library that the project needs anyway had them."""
