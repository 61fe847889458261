"""Where a calibration came from, as its file remembers it."""

import dataclasses
import platform
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

import numpy as np

from rig_calib.rig_calibration import CalibratedCamera, RigCalibration
from rig_protocol.poses import inverse, rotation_angle_deg

_LIBRARIES = ("kinect-rig", "numpy", "scipy", "opencv-python-headless")


def with_provenance(
    calibration: RigCalibration, source: str, agents: int, settings: dict[str, Any], **more: Any
) -> RigCalibration:
    """The same calibration, stamped with the time, its source and agents, the versions and the settings.

    What its provenance told before, it still tells.
    """
    origin = {"source": source, "agents": agents, "versions": _versions()}
    provenance = {**origin, **calibration.provenance, "settings": settings, **more}
    return dataclasses.replace(calibration, created=_now(), provenance=provenance)


def with_recalibration(
    calibration: RigCalibration, known: RigCalibration, camera_id: int, frames: int, **origin: Any
) -> RigCalibration:
    """A calibration with one camera found anew: the provenance of the `known` one and a record more.

    The list `recalibrated` holds, oldest first: camera and name, when, by how much it moved (null for one
    that had no pose), on how many frames, and `origin` (source, settings, ...).
    """
    camera = calibration.camera(camera_id)
    if camera is None:
        return calibration
    created = _now()
    record = {
        "camera": camera_id,
        "name": camera.name,
        "when": created,
        "moved": _moved(known, camera),
        "frames": frames,
        "versions": _versions(),
        **origin,
    }
    before = known.provenance.get("recalibrated", [])
    provenance = {**known.provenance, "recalibrated": [*before, record]}
    return dataclasses.replace(calibration, created=created, provenance=provenance)


def _moved(known: RigCalibration, camera: CalibratedCamera) -> dict[str, float] | None:
    before = known.camera(camera.id)
    if before is None:
        return None
    T = inverse(before.T_rig_camera) @ camera.T_rig_camera
    return {"deg": rotation_angle_deg(T), "mm": float(np.linalg.norm(T[:3, 3]) * 1e3)}


def _versions() -> dict[str, str]:
    return {"python": platform.python_version()} | {name: version(name) for name in _LIBRARIES}


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
