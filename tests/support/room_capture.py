"""A rig folder of the box room: what a few Kinects saw of it, a little brighter from frame to frame."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from rig_protocol.frames import RgbdFrame
from rig_protocol.rig_folder import CameraEntry, RigDescription, write_rig_folder
from support.box_room import MODEL, BoxRoom, ring_poses


def write_room_capture(
    folder: Path, frames: int = 3, cameras: int = 3, exposures: Mapping[int, float] | None = None
) -> Path:
    """Cameras 0 to `cameras` − 1 of the ring; panoramic frame k is k grey levels brighter than the room.

    `exposures`: factors on the colours of some cameras.
    """
    room, taken = BoxRoom(), []
    for camera_id, T_rig_camera in ring_poses(cameras).items():
        view = room.view(camera_id, T_rig_camera, (exposures or {}).get(camera_id, 1.0))
        first = RgbdFrame(
            camera_id, 0, 0, color=view.color[0], depth_mm=view.depth_mm[0], depth_frame="color"
        )
        taken += [replace(first, sequence=k, color=view.color[0] + np.uint8(k)) for k in range(frames)]
    entries = tuple(CameraEntry(camera_id, f"cam{camera_id:02d}", MODEL) for camera_id in ring_poses(cameras))
    write_rig_folder(folder, RigDescription(entries), taken)
    return folder
