"""What a recording tells of its rig beside frames: cameras, agents, settings, calibration; and back."""

import functools
from collections.abc import Mapping
from typing import Any

from rig_calib.rig_calibration import RigCalibration
from rig_protocol.errors import DataError
from rig_protocol.message_fields import codec_ids, integer, number, optional, text
from rig_protocol.messages import Hello
from rig_protocol.recording import CALIBRATION, DESCRIPTION, HELLOS, SETTINGS
from rig_protocol.rig_folder import RigDescription
from rig_server.config import MAX_CAMERAS, RigSettings

_MAX_TEXT = 64  # bytes, as in a hello
_MAX_CODECS = 16


def take_documents(
    settings: RigSettings,
    description: RigDescription,
    hellos: Mapping[int, Hello],
    calibration: RigCalibration | None,
) -> dict[str, Any]:
    """The documents by their name in the recording; none of the cameras before the first has come.

    `calibration`: the one in force.
    """
    documents: dict[str, Any] = {SETTINGS: settings.model_dump(mode="json", exclude={"key_file"})}
    if hellos:
        documents[DESCRIPTION] = description.to_dict()
        documents[HELLOS] = {"agents": [_told(i, hello) for i, hello in sorted(hellos.items())]}
    if calibration is not None:
        documents[CALIBRATION] = _calibration_document(calibration)
    return documents


def recorded_hellos(document: Any, description: RigDescription) -> dict[int, Hello]:
    """The agents of a recording; DataError when its document is malformed."""
    agents = document.get("agents") if isinstance(document, Mapping) else None
    if not isinstance(agents, list) or not all(isinstance(agent, Mapping) for agent in agents):
        raise DataError(f"{HELLOS} must hold a list `agents`")
    hellos = (_hello(agent, description) for agent in agents[:MAX_CAMERAS])
    return {hello.camera_id: hello for hello in hellos if hello.camera_id is not None}


@functools.lru_cache(maxsize=1)
def _calibration_document(calibration: RigCalibration) -> dict[str, Any]:
    """The same object for the same calibration: a recording asks twice a second what is new."""
    return calibration.to_dict()


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
