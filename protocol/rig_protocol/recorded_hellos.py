"""The agents of a take as it tells them (`hellos.json`), and back."""

from collections.abc import Mapping
from typing import Any

from rig_protocol.errors import DataError
from rig_protocol.message_fields import codec_ids, integer, number, optional, text
from rig_protocol.messages import Hello
from rig_protocol.recording import HELLOS
from rig_protocol.rig_folder import RigDescription

_MAX_AGENTS = 64
_MAX_TEXT = 64  # bytes, as in a hello
_MAX_CODECS = 16


def told_hellos(hellos: Mapping[int, Hello]) -> dict[str, Any]:
    """The document of the agents, by the ids of their cameras."""
    return {"agents": [_told(camera_id, hello) for camera_id, hello in sorted(hellos.items())]}


def recorded_hellos(document: Any, description: RigDescription) -> dict[int, Hello]:
    """The agents of a recording; DataError when its document is malformed."""
    agents = document.get("agents") if isinstance(document, Mapping) else None
    if not isinstance(agents, list) or not all(isinstance(agent, Mapping) for agent in agents):
        raise DataError(f"{HELLOS} must hold a list `agents`")
    hellos = (_hello(agent, description) for agent in agents[:_MAX_AGENTS])
    return {hello.camera_id: hello for hello in hellos if hello.camera_id is not None}


def _told(camera_id: int, hello: Hello) -> dict[str, Any]:
    kept = ("name", "serial", "port_path", "fps", "software")
    codecs = {"color_codecs": list(hello.color_codecs), "depth_codecs": list(hello.depth_codecs)}
    return {"camera_id": camera_id} | {name: getattr(hello, name) for name in kept} | codecs


def _hello(values: Mapping[str, Any], description: RigDescription) -> Hello:
    camera_id = integer(values, "camera_id", 0, 255)
    if camera_id not in description.camera_ids:
        raise DataError(f"{HELLOS} names camera {camera_id}, of which nothing else is told")
    return Hello(
        name=text(values, "name", _MAX_TEXT),
        camera_id=camera_id,
        serial=optional(text, values, "serial", _MAX_TEXT),
        port_path=optional(text, values, "port_path", _MAX_TEXT),
        model=description.camera(camera_id).model,
        color_codecs=codec_ids(values, "color_codecs", _MAX_CODECS),
        depth_codecs=codec_ids(values, "depth_codecs", _MAX_CODECS),
        fps=number(values, "fps", 0.1, 1000.0),
        software=text(values, "software", _MAX_TEXT),
    )
