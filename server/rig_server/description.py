"""The rig as the server knows it before calibration: rig.toml and what the agents' hellos say."""

import re
from collections.abc import Mapping
from dataclasses import replace

from rig_protocol.camera import CameraModel
from rig_protocol.messages import Hello
from rig_protocol.rig_folder import CameraEntry, RigDescription, RingDrawing
from rig_server.config import CAMERA_NAME, CameraSettings, RigSettings, read_intrinsics


def describe_rig(settings: RigSettings, hellos: Mapping[int, Hello]) -> RigDescription:
    """Every camera that said hello, ascending: name and intrinsics of rig.toml before the agent's own.

    Nominal poses follow from the ring's drawing when there is one.
    """
    listed = {camera.id: camera for camera in settings.cameras}
    ring = None if settings.ring is None else settings.ring.drawing()
    names = camera_names(settings, hellos)
    cameras = [
        _entry(camera_id, names[camera_id], hello, listed.get(camera_id), ring)
        for camera_id, hello in sorted(hellos.items())
    ]
    return RigDescription(tuple(cameras), ring)


def camera_names(settings: RigSettings, hellos: Mapping[int, Hello]) -> dict[int, str]:
    """Names by camera id, unique and fit for a file name: rig.toml's, else the agent's, else cam00, ...

    Holds the listed cameras and those that said hello.
    """
    names = {camera.id: camera.label for camera in settings.cameras}
    for camera_id, hello in sorted(hellos.items()):
        own = f"cam{camera_id:02d}"
        # Another slot's default name would mislead, even while that slot is empty.
        fit = re.fullmatch(CAMERA_NAME, hello.name) and not re.fullmatch(r"cam\d+", hello.name)
        names.setdefault(camera_id, hello.name if fit and hello.name not in names.values() else own)
    return names


def _entry(
    camera_id: int, name: str, hello: Hello, listed: CameraSettings | None, ring: RingDrawing | None
) -> CameraEntry:
    file = None if listed is None else listed.intrinsics
    return CameraEntry(
        id=camera_id,
        name=name,
        model=hello.model if file is None else _completed(read_intrinsics(file), hello.model),
        T_rig_camera=None if ring is None else ring.T_rig_camera(camera_id),
    )


def _completed(measured: CameraModel, told: CameraModel) -> CameraModel:
    """A measured model; where it holds only the defaults, the agent's factory calibration knows more.

    `rig-calib intrinsics` without infrared images measures the colour camera alone.
    """
    default = CameraModel()
    if measured.depth in (None, default.depth):
        measured = replace(measured, depth=told.depth, T_color_depth=told.T_color_depth)
    if measured.raw_model == default.raw_model:
        measured = replace(measured, raw_model=told.raw_model)
    return measured
