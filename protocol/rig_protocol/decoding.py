"""From what crossed the wire, or was recorded from it, to frames."""

from typing import Any

import cv2
import numpy as np

from rig_protocol.codecs import COLOR_CODECS, DEPTH_CODECS, codec
from rig_protocol.errors import DataError
from rig_protocol.frames import EncodedFrame, Payload, RgbdFrame


def decode_frame(frame: EncodedFrame, demosaic: bool = False) -> RgbdFrame:
    """Decode both images; `demosaic` adds the colour image of a Bayer mosaic.

    DataError when a payload is malformed or in a codec of the other stream.
    """
    images: dict[str, Any] = {}
    for payload, known in ((frame.color, COLOR_CODECS), (frame.depth, DEPTH_CODECS)):
        if payload is not None:
            images |= _decode_payload(payload, known)
    if demosaic and "bayer" in images:
        images["color"] = np.asarray(cv2.cvtColor(images["bayer"], cv2.COLOR_BayerGRBG2BGR), np.uint8)
    return RgbdFrame(
        camera_id=frame.camera_id,
        sequence=frame.sequence,
        timestamp_ns=frame.timestamp_ns,
        uncertainty_ns=frame.uncertainty_ns,
        depth_frame=frame.depth_frame,
        damaged=frame.damaged,
        received_ns=frame.received_ns,
        gravity=frame.gravity,
        **images,
    )


def _decode_payload(payload: Payload, known: tuple[int, ...]) -> dict[str, Any]:
    """The image under the name of its RgbdFrame field."""
    if payload.codec_id not in known:
        raise DataError(f"codec {payload.codec_id} is none of this stream's: {known}")
    chosen = codec(payload.codec_id)
    field = "color" if chosen.image in ("bgr", "grey") else chosen.image
    return {field: chosen.decode(payload.data)}
