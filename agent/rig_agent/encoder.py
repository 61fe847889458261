"""From a frame to what crosses the wire, in the codecs that the server chose."""

import cv2
import numpy as np

from rig_protocol.codecs import codec
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


def encode_frame(frame: RgbdFrame, color_codec: int | None, depth_codec: int | None) -> EncodedFrame:
    """Encode both images; a stream without codec, or without image in this frame, has no payload.

    A Bayer image is demosaiced for a codec of BGR images. ValueError when a codec cannot take the image
    that the frame has; DataError for an unknown codec id.
    """
    return EncodedFrame(
        camera_id=frame.camera_id,
        sequence=frame.sequence,
        timestamp_ns=frame.timestamp_ns,
        uncertainty_ns=frame.uncertainty_ns,
        color=None if color_codec is None else _color_payload(frame, color_codec),
        depth=None if depth_codec is None else _depth_payload(frame, depth_codec),
        depth_frame=frame.depth_frame,
        damaged=frame.damaged,
    )


def _color_payload(frame: RgbdFrame, codec_id: int) -> Payload | None:
    chosen = codec(codec_id)
    image = frame.color if frame.bayer is None else frame.bayer
    if image is None:
        return None
    if frame.bayer is not None and chosen.image == "bgr":
        image = _demosaic(frame.bayer)
    elif (frame.bayer is not None) != (chosen.image == "bayer"):
        raise ValueError(f"codec {chosen.name} cannot take the colour image of camera {frame.camera_id}")
    return Payload(codec_id, chosen.encode(image))


def _depth_payload(frame: RgbdFrame, codec_id: int) -> Payload | None:
    chosen = codec(codec_id)
    image = frame.depth_mm if frame.raw is None else frame.raw
    if image is None:
        return None
    if chosen.image != ("depth_mm" if frame.raw is None else "raw"):
        raise ValueError(f"codec {chosen.name} cannot take the depth image of camera {frame.camera_id}")
    return Payload(codec_id, chosen.encode(image))


def _kind_of_color(frame: RgbdFrame) -> str:
    return "bgr" if frame.color is not None and frame.color.ndim == 3 else "grey"


def _demosaic(bayer: ImageU8) -> ImageU8:
    return np.asarray(cv2.cvtColor(bayer, cv2.COLOR_BayerGRBG2BGR), np.uint8)
