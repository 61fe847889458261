"""CameraView: all that calibration and fusion are given of one camera."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_protocol.camera import CameraModel
from rig_protocol.frames import DepthFrame, ImageU8, ImageU16, PanoramicFrame, RgbdFrame
from rig_protocol.gravity import KINECT_SIGMA_DEG, common_gravity
from rig_protocol.poses import Pose
from rig_protocol.rig_folder import RigDescription


@dataclass(frozen=True, slots=True, eq=False)
class CameraView:
    """Images of one camera over K panoramic frames, as delivered by the sensor.

    `color`: K images (H,W,3) BGR or (H,W) grey, u8. Depth, when there is any: K images of raw disparity
    (`raw`, 2047 = none) or of millimetres (`depth_mm`, 0 = none) on the grid of `depth_frame`. `gravity`
    (3,): unit vector down in the colour camera frame, where an accelerometer measured it; `gravity_sigma_deg`
    its standard deviation on each axis.
    """

    camera_id: int
    name: str
    model: CameraModel
    color: tuple[ImageU8, ...]
    raw: tuple[ImageU16, ...] = ()
    depth_mm: tuple[ImageU16, ...] = ()
    depth_frame: DepthFrame = "depth"
    T_rig_nominal: Pose | None = None
    gravity: npt.NDArray[np.float64] | None = None
    gravity_sigma_deg: float = KINECT_SIGMA_DEG


def views_from_panoramas(
    description: RigDescription, panoramas: Sequence[PanoramicFrame]
) -> list[CameraView]:
    """One view a camera of the rig, from what the panoramic frames hold of it; damaged frames are left out.

    A camera that no panoramic frame holds has no images, and so no depth; its view still exists.
    """
    return [
        _view(description, camera_id, [panorama.frames.get(camera_id) for panorama in panoramas])
        for camera_id in description.camera_ids
    ]


def _view(description: RigDescription, camera_id: int, frames: Sequence[RgbdFrame | None]) -> CameraView:
    entry = description.camera(camera_id)
    good = [frame for frame in frames if frame is not None and not frame.damaged]
    gravity = common_gravity([frame.gravity for frame in good if frame.gravity is not None])
    return CameraView(
        camera_id=camera_id,
        name=entry.name,
        model=entry.model,
        color=tuple(image for image in map(_color, good) if image is not None),
        raw=tuple(frame.raw for frame in good if frame.raw is not None),
        depth_mm=tuple(frame.depth_mm for frame in good if frame.depth_mm is not None),
        depth_frame=good[0].depth_frame if good else "depth",
        T_rig_nominal=entry.T_rig_camera,
        gravity=None if gravity is None else np.array(gravity.down),
        gravity_sigma_deg=KINECT_SIGMA_DEG if gravity is None else gravity.sigma_deg,
    )


def _color(frame: RgbdFrame) -> ImageU8 | None:
    if frame.color is not None or frame.bayer is None:
        return frame.color
    return np.asarray(cv2.cvtColor(frame.bayer, cv2.COLOR_BayerGRBG2BGR), dtype=np.uint8)
