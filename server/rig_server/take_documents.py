"""What a recording tells of its rig beside frames: cameras, agents, settings, calibration."""

import functools
from collections.abc import Mapping
from typing import Any

from rig_calib.rig_calibration import RigCalibration
from rig_protocol.messages import Hello
from rig_protocol.recorded_hellos import told_hellos
from rig_protocol.recording import CALIBRATION, DESCRIPTION, HELLOS, SETTINGS
from rig_protocol.rig_folder import RigDescription
from rig_server.config import RigSettings


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
        documents[HELLOS] = told_hellos(hellos)
    if calibration is not None:
        documents[CALIBRATION] = _calibration_document(calibration)
    return documents


@functools.lru_cache(maxsize=1)
def _calibration_document(calibration: RigCalibration) -> dict[str, Any]:
    """The same object for the same calibration: a recording asks twice a second what is new."""
    return calibration.to_dict()
