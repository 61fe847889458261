"""Codecs by wire id and by name, and the order in which a program prefers them."""

import numpy as np

from rig_protocol.codecs.base import Codec, ImageKind
from rig_protocol.codecs.color import BayerCodec, BgrCodec, GreyCodec
from rig_protocol.codecs.depth import DisparityCodec, MillimetreCodec
from rig_protocol.codecs.jpeg import JpegCodec
from rig_protocol.codecs.raw import UncompressedCodec
from rig_protocol.errors import DataError

_COLOR: tuple[Codec, ...] = (
    BayerCodec(1),
    BgrCodec(2),
    GreyCodec(3),
    JpegCodec(8, "bgr-jpeg", "bgr"),
    JpegCodec(9, "grey-jpeg", "grey"),
    UncompressedCodec(16, "bayer-uncompressed", "bayer"),
    UncompressedCodec(17, "bgr-uncompressed", "bgr"),
    UncompressedCodec(18, "grey-uncompressed", "grey"),
)
_DEPTH: tuple[Codec, ...] = (
    DisparityCodec(32),
    MillimetreCodec(33),
    UncompressedCodec(48, "disparity-uncompressed", "raw"),
    UncompressedCodec(49, "depth-uncompressed", "depth_mm"),
)
_BY_ID = {codec.id: codec for codec in _COLOR + _DEPTH}
_BY_NAME = {codec.name: codec for codec in _COLOR + _DEPTH}

COLOR_CODECS = tuple(codec.id for codec in _COLOR)
"""Wire ids for colour, best first: lossless, then JPEG, then uncompressed."""

DEPTH_CODECS = tuple(codec.id for codec in _DEPTH)
"""Wire ids for depth, best first."""


def codec(codec_id: int) -> Codec:
    """The codec with this wire id; DataError for an unknown one."""
    if codec_id not in _BY_ID:
        raise DataError(f"codec {codec_id} is unknown to this program")
    return _BY_ID[codec_id]


def codec_by_name(name: str) -> Codec:
    """The codec with this name; DataError lists those that exist."""
    if name not in _BY_NAME:
        raise DataError(f"codec {name!r} is none of {', '.join(_BY_NAME)}")
    return _BY_NAME[name]


def codecs_for(image: ImageKind) -> tuple[int, ...]:
    """Wire ids of the codecs of one kind of image, best first."""
    return tuple(codec.id for codec in _COLOR + _DEPTH if codec.image == image)


def warm_up() -> None:
    """Load or compile the decoders, seconds the first time on a machine: call it before frames arrive."""
    for one in _BY_ID.values():
        shape = (2, 2, 3) if one.image == "bgr" else (2, 2)
        dtype = np.uint16 if one.image in ("raw", "depth_mm") else np.uint8
        one.decode(one.encode(np.zeros(shape, dtype)))
