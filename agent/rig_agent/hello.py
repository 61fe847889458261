"""What the agent says about itself and its camera when it asks to join the rig."""

from importlib.metadata import version

from rig_agent.cipher_choice import ciphers_by_speed
from rig_agent.config import AgentSettings, Manner
from rig_agent.sources.base import SourceDescription
from rig_protocol.codecs import Codec, ImageKind, codec, codecs_for
from rig_protocol.codecs.raw import UncompressedCodec
from rig_protocol.messages import Hello

# The manners that an agent offers, best first. JPEG comes last unless it is wanted: a server asks for it
# only when the link carries nothing better, and never when its [link] jpeg = false.
_OFFERS: dict[Manner, tuple[Manner, ...]] = {
    "lossless": ("lossless", "raw", "jpeg"),
    "jpeg": ("jpeg", "lossless", "raw"),
    "raw": ("raw", "lossless", "jpeg"),
}


def make_hello(settings: AgentSettings, source: SourceDescription, streams: bool = True) -> Hello:
    """The hello of this agent with this source; the operator's slot wins over a recording's.

    Without `streams` it offers no frames.
    """
    slot = source.camera_id if settings.camera is None else settings.camera
    return Hello(
        name=settings.display_name(slot),
        camera_id=slot,
        serial=source.serial,
        port_path=source.port_path,
        model=source.model,
        color_codecs=_offer(source.color_image, settings.color) if streams else (),
        depth_codecs=_offer(source.depth_image, settings.depth) if streams else (),
        fps=min(source.fps, settings.fps or source.fps),
        software=f"kinect-rig {version('kinect-rig')}",
        ciphers=ciphers_by_speed(),
        controls=True,
    )


def _offer(image: ImageKind | None, wanted: Manner) -> tuple[int, ...]:
    """Wire ids for one kind of image, best first; none for a stream that does not exist."""
    if image is None:
        return ()
    # JPEG of a Bayer mosaic would be useless: the encoder demosaics it first.
    kinds: list[ImageKind] = [image, "bgr"] if image == "bayer" else [image]
    known = [codec(id_) for kind in kinds for id_ in codecs_for(kind)]
    fitting = [one for one in known if one.image == image or not one.lossless]
    return tuple(one.id for manner in _OFFERS[wanted] for one in fitting if _manner(one) == manner)


def _manner(one: Codec) -> Manner:
    if not one.lossless:
        return "jpeg"
    return "raw" if isinstance(one, UncompressedCodec) else "lossless"
