"""What a recording tells of its rig beside frames: cameras, agents, settings, calibration."""

from collections.abc import Mapping
from typing import Any

from rig_protocol.messages import Hello
from rig_protocol.recorded_hellos import told_hellos
from rig_protocol.recording import CALIBRATION, DESCRIPTION, HELLOS, SETTINGS
from rig_protocol.rig_folder import RigDescription, read_json
from rig_server.config import RigSettings


def take_documents(
    settings: RigSettings, description: RigDescription, hellos: Mapping[int, Hello]
) -> dict[str, Any]:
    """The documents by their name in the recording; none of the cameras before the first has come."""
    documents: dict[str, Any] = {SETTINGS: settings.model_dump(mode="json", exclude={"key_file"})}
    if hellos:
        documents[DESCRIPTION] = description.to_dict()
        documents[HELLOS] = told_hellos(hellos)
    if settings.watch.calibration is not None:
        documents[CALIBRATION] = read_json(settings.watch.calibration)
    return documents
