"""Images as bytes: lossless, JPEG and uncompressed codecs behind one registry (CODECS.md)."""

from rig_protocol.codecs.base import Codec, ImageKind
from rig_protocol.codecs.memory import keep_freed_memory
from rig_protocol.codecs.registry import (
    COLOR_CODECS,
    DEPTH_CODECS,
    codec,
    codec_by_name,
    codecs_for,
    warm_up,
)

__all__ = [
    "COLOR_CODECS",
    "DEPTH_CODECS",
    "Codec",
    "ImageKind",
    "codec",
    "codec_by_name",
    "codecs_for",
    "keep_freed_memory",
    "warm_up",
]
