"""The forms in which a Kinect's images come through libfreenect, and what becomes of them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from rig_agent.sources.frame_pairing import Stream
from rig_agent.sources.libfreenect import (
    DEPTH_11BIT,
    DEPTH_11BIT_PACKED,
    RESOLUTION_HIGH,
    RESOLUTION_MEDIUM,
    VIDEO_BAYER,
    VIDEO_IR_8BIT,
    VIDEO_RGB,
)
from rig_protocol.frames import ImageU8, ImageU16

ColorName = Literal["bayer", "rgb", "ir"]
DepthName = Literal["11bit", "11bit_packed"]

_WIDTH, _HEIGHT = 640, 480
_PIXELS_A_GROUP, _BYTES_A_GROUP = 8, 11  # of packed 11-bit values


@dataclass(frozen=True, slots=True)
class ImageFormat:
    """One form of one stream: libfreenect's numbers for it, and the array that holds an image.

    `converted`: libfreenect assembles packets in a buffer of its own and converts whole frames into ours.
    Otherwise it writes packets of the next frame into our buffer before it delivers a frame that lost its
    last packet: such an image must be copied, never swapped.
    """

    stream: Stream
    code: int
    resolution: int
    shape: tuple[int, ...]
    dtype: type[np.uint8] | type[np.uint16]
    converted: bool

    @property
    def bytes(self) -> int:
        """Size of an image."""
        return int(np.prod(self.shape)) * np.dtype(self.dtype).itemsize

    def empty(self) -> npt.NDArray[Any]:
        """An array for one image."""
        return np.empty(self.shape, self.dtype)


COLOR: dict[ColorName, ImageFormat] = {
    "bayer": ImageFormat("video", VIDEO_BAYER, RESOLUTION_MEDIUM, (_HEIGHT, _WIDTH), np.uint8, False),
    "rgb": ImageFormat("video", VIDEO_RGB, RESOLUTION_MEDIUM, (_HEIGHT, _WIDTH, 3), np.uint8, True),
    "ir": ImageFormat("video", VIDEO_IR_8BIT, RESOLUTION_MEDIUM, (488, _WIDTH), np.uint8, True),
}
HIGH_COLOR: dict[ColorName, ImageFormat] = {
    "bayer": ImageFormat("video", VIDEO_BAYER, RESOLUTION_HIGH, (1024, 1280), np.uint8, False),
    "rgb": ImageFormat("video", VIDEO_RGB, RESOLUTION_HIGH, (1024, 1280, 3), np.uint8, True),
    "ir": ImageFormat("video", VIDEO_IR_8BIT, RESOLUTION_HIGH, (1024, 1280), np.uint8, True),
}
"""About ten images a second, and for infrared only while depth is off."""
_PACKED_BYTES = _WIDTH * _HEIGHT // _PIXELS_A_GROUP * _BYTES_A_GROUP
DEPTH: dict[DepthName, ImageFormat] = {
    "11bit": ImageFormat("depth", DEPTH_11BIT, RESOLUTION_MEDIUM, (_HEIGHT, _WIDTH), np.uint16, True),
    "11bit_packed": ImageFormat(
        "depth", DEPTH_11BIT_PACKED, RESOLUTION_MEDIUM, (_PACKED_BYTES,), np.uint8, False
    ),
}


def unpack_11bit(packed: ImageU8) -> ImageU16:
    """(480,640) disparity of the sensor's stream of 11-bit values, most significant bit first."""
    groups = packed.reshape(-1, _BYTES_A_GROUP).astype(np.uint16)
    pixels = np.empty((len(groups), _PIXELS_A_GROUP), np.uint16)
    for pixel in range(_PIXELS_A_GROUP):
        first, skipped = divmod(11 * pixel, 8)
        unused = 16 - 11 - skipped  # bits of two bytes to the right of the value; negative: a third byte
        value = groups[:, first] << 8 | groups[:, first + 1]
        if unused >= 0:
            value >>= unused
        else:
            value = value << -unused | groups[:, first + 2] >> 8 + unused
        pixels[:, pixel] = value & 0x7FF
    return pixels.reshape(_HEIGHT, _WIDTH)


def _bgr(rgb: ImageU8) -> ImageU8:
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), np.uint8)


def color_images(name: ColorName, image: npt.NDArray[Any]) -> dict[str, Any]:
    """A video image under the name of its RgbdFrame field."""
    match name:
        case "bayer":
            return {"bayer": image}
        case "rgb":
            return {"color": _bgr(image)}
        case "ir":
            return {"color": image}


_AS_DISPARITY: dict[DepthName, Callable[[npt.NDArray[Any]], ImageU16]] = {
    "11bit": lambda image: image,
    "11bit_packed": unpack_11bit,
}


def disparity(name: DepthName, image: npt.NDArray[Any]) -> ImageU16:
    """(480,640) raw disparity of a depth image."""
    return _AS_DISPARITY[name](image)
