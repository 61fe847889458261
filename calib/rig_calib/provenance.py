"""Where a calibration came from, as its file remembers it."""

import dataclasses
import platform
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

from rig_calib.rig_calibration import RigCalibration

_LIBRARIES = ("kinect-rig", "numpy", "scipy", "opencv-python-headless")


def with_provenance(
    calibration: RigCalibration, source: str, agents: int, settings: dict[str, Any], **more: Any
) -> RigCalibration:
    """The same calibration, stamped with the time, its source and agents, the versions and the settings."""
    versions = {"python": platform.python_version()} | {name: version(name) for name in _LIBRARIES}
    return dataclasses.replace(
        calibration,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        provenance={"source": source, "agents": agents, "versions": versions, "settings": settings, **more},
    )
