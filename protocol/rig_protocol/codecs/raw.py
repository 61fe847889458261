"""Uncompressed images: the header, then the pixels row by row, u16 little-endian."""

from dataclasses import dataclass

import numpy as np

from rig_protocol.codecs.base import Bytes, Image, ImageKind, check_image, pack_header, unpack_header
from rig_protocol.errors import DataError
from rig_protocol.frames import NO_DISPARITY


@dataclass(frozen=True, slots=True)
class UncompressedCodec:
    """Pixels as they are: for links with room to spare and processors without any."""

    id: int
    name: str
    image: ImageKind
    lossless: bool = True

    def encode(self, image: Image) -> bytes:
        """Header and pixels."""
        check_image(image, self.image)
        return pack_header(image) + image.astype(_pixel(self.image), copy=False).tobytes()

    def decode(self, data: Bytes) -> Image:
        """A writable copy of the pixels."""
        height, width, body = unpack_header(data)
        shape = (height, width, 3) if self.image == "bgr" else (height, width)
        pixel = _pixel(self.image)
        expected = int(np.prod(shape)) * pixel.itemsize
        if len(body) != expected:
            raise DataError(f"{self.name} image {shape} needs {expected} bytes, the payload has {len(body)}")
        image = np.frombuffer(body, pixel).astype(pixel.newbyteorder("=")).reshape(shape)
        if self.image == "raw" and image.max() > NO_DISPARITY:
            raise DataError(f"raw disparity has 11 bits, found {image.max()}")
        return image


def _pixel(kind: ImageKind) -> np.dtype[np.uint8] | np.dtype[np.uint16]:
    return np.dtype("<u2") if kind in ("raw", "depth_mm") else np.dtype(np.uint8)
