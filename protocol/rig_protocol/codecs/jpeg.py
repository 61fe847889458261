"""JPEG colour and grey for links that have no room for every bit."""

from dataclasses import dataclass

import cv2
import numpy as np

from rig_protocol.codecs.base import Bytes, Image, ImageKind, check_image, pack_header, unpack_header
from rig_protocol.errors import DataError

QUALITY = 90
"""The setting usual where the picture matters more than the last bytes."""

_COMPONENTS = {"bgr": 3, "grey": 1}
_FLAGS = {"bgr": cv2.IMREAD_COLOR, "grey": cv2.IMREAD_GRAYSCALE}
_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_WITHOUT_LENGTH = frozenset([0x01, *range(0xD0, 0xD9)])


@dataclass(frozen=True, slots=True)
class JpegCodec:
    """Baseline JPEG behind the common image header."""

    id: int
    name: str
    image: ImageKind
    lossless: bool = False

    def encode(self, image: Image) -> bytes:
        """Header and JPEG of quality 90."""
        check_image(image, self.image)
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        return pack_header(image) + data.tobytes()

    def decode(self, data: Bytes) -> Image:
        """The image; the sizes within the JPEG must agree with the header before it is decoded."""
        height, width, body = unpack_header(data)
        if _jpeg_shape(body) != (height, width, _COMPONENTS[self.image]):
            raise DataError(f"{self.name} payload does not hold a JPEG of {width}×{height} pixels")
        try:
            image = cv2.imdecode(
                np.frombuffer(body, np.uint8), _FLAGS[self.image] | cv2.IMREAD_IGNORE_ORIENTATION
            )
        except cv2.error as error:
            raise DataError(f"{self.name} payload cannot be decoded: {error}") from error
        if image is None or image.shape[:2] != (height, width):
            raise DataError(f"{self.name} payload cannot be decoded")
        return image


def _jpeg_shape(data: memoryview) -> tuple[int, int, int] | None:
    """Height, width and components that the first frame header states; None when there is none."""
    at = 2 if bytes(data[:2]) == b"\xff\xd8" else len(data)
    while at + 10 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker in _START_OF_FRAME:
            height, width = int.from_bytes(data[at + 5 : at + 7]), int.from_bytes(data[at + 7 : at + 9])
            return height, width, data[at + 9]
        at += 2 if marker in _WITHOUT_LENGTH else 2 + int.from_bytes(data[at + 2 : at + 4])
    return None
