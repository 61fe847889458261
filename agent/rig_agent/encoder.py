"""From a frame to what crosses the wire, in the codecs that the server chose."""

import cv2
import numpy as np

from rig_agent.config import Manner
from rig_protocol.codecs import ImageKind, codec, codecs_for
from rig_protocol.codecs.raw import UncompressedCodec
from rig_protocol.frames import EncodedFrame, ImageU8, Payload, RgbdFrame


def fits(frame: RgbdFrame, color_codec: int | None, depth_codec: int | None) -> bool:
    """Whether the codecs take this frame's images; not so when the camera was just switched to infrared."""
    color_kinds = ("bayer", "bgr") if frame.bayer is not None else (_kind_of_color(frame),)
    depth_kinds = ("depth_mm",) if frame.raw is None else ("raw",)
    return all(
        codec_id is None or codec(codec_id).image in kinds or not present
        for codec_id, kinds, present in (
            (color_codec, color_kinds, frame.bayer is not None or frame.color is not None),
            (depth_codec, depth_kinds, frame.raw is not None or frame.depth_mm is not None),
        )
    )


def codecs_to_keep(frame: RgbdFrame, color: Manner, depth: Manner) -> tuple[int | None, int | None]:
    """Lossless codecs of colour and depth for the images of a frame; uncompressed where that is wanted."""
    color_kind: ImageKind = "bayer" if frame.bayer is not None else _kind_of_color(frame)
    depth_kind: ImageKind = "depth_mm" if frame.raw is None else "raw"
    return _lossless(color_kind, color), _lossless(depth_kind, depth)


def encode_frame(
    frame: RgbdFrame, color_codec: int | None, depth_codec: int | None, known: EncodedFrame | None = None
) -> EncodedFrame:
    """Encode both images; a stream without codec, or without image in this frame, has no payload.

    `known`: the same frame encoded before; what it holds in the wanted codec is not encoded again.
    A Bayer image is demosaiced for a codec of BGR images. ValueError when a codec cannot take the image
    that the frame has; DataError for an unknown codec id.
    """
    return EncodedFrame(
        camera_id=frame.camera_id,
        sequence=frame.sequence,
        timestamp_ns=frame.timestamp_ns,
        uncertainty_ns=frame.uncertainty_ns,
        color=_known(known.color if known else None, color_codec) or _color_payload(frame, color_codec),
        depth=_known(known.depth if known else None, depth_codec) or _depth_payload(frame, depth_codec),
        depth_frame=frame.depth_frame,
        damaged=frame.damaged,
    )


def _known(payload: Payload | None, codec_id: int | None) -> Payload | None:
    return payload if payload is not None and payload.codec_id == codec_id else None


def _color_payload(frame: RgbdFrame, codec_id: int | None) -> Payload | None:
    image = frame.color if frame.bayer is None else frame.bayer
    if codec_id is None or image is None:
        return None
    chosen = codec(codec_id)
    if frame.bayer is not None and chosen.image == "bgr":
        image = _demosaic(frame.bayer)
    elif (frame.bayer is not None) != (chosen.image == "bayer"):
        raise ValueError(f"codec {chosen.name} cannot take the colour image of camera {frame.camera_id}")
    return Payload(codec_id, chosen.encode(image))


def _depth_payload(frame: RgbdFrame, codec_id: int | None) -> Payload | None:
    image = frame.depth_mm if frame.raw is None else frame.raw
    if codec_id is None or image is None:
        return None
    chosen = codec(codec_id)
    if chosen.image != ("depth_mm" if frame.raw is None else "raw"):
        raise ValueError(f"codec {chosen.name} cannot take the depth image of camera {frame.camera_id}")
    return Payload(codec_id, chosen.encode(image))


def _lossless(kind: ImageKind, manner: Manner) -> int:
    """The compressing one, or the other where images are wanted raw."""
    fitting = [codec(id_) for id_ in codecs_for(kind) if codec(id_).lossless]
    raw = manner == "raw"
    return next(one.id for one in fitting if isinstance(one, UncompressedCodec) == raw)


def _kind_of_color(frame: RgbdFrame) -> ImageKind:
    return "bgr" if frame.color is not None and frame.color.ndim == 3 else "grey"


def _demosaic(bayer: ImageU8) -> ImageU8:
    return np.asarray(cv2.cvtColor(bayer, cv2.COLOR_BayerGRBG2BGR), np.uint8)
