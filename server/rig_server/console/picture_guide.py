"""How each camera's pictures are made upright, coloured and tinted, by what is known of the rig."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from rig_calib.overlap import seen_grid
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.camera import CameraModel, RawDepthModel
from rig_protocol.frames import ImageU8
from rig_protocol.poses import Pose, inverse
from rig_protocol.rig_folder import RigDescription
from rig_server.console.camera_pictures import Tint
from rig_server.console.upright import drawn_turns

# A hue a pair, the same in both its images; neighbouring pairs of a ring never share one.
_PAIR_HUES_DEG = (28, 190, 95, 285, 150, 330)


@dataclass(frozen=True, slots=True, eq=False)
class PictureGuide:
    """By camera id: quarter turns clockwise by its pose, disparity models, tints of what others see, too."""

    turns: Mapping[int, int]
    raw_models: Mapping[int, RawDepthModel]
    tints: Mapping[int, Tint]

    @classmethod
    def of(cls, description: RigDescription, calibration: RigCalibration | None) -> "PictureGuide":
        """By the calibration, or where there is none by the drawing."""
        models = {camera.id: camera.model for camera in description.cameras}
        poses = {} if calibration is None else dict(calibration.poses)
        frame = "ring" if calibration is None else calibration.rig_frame
        turns = drawn_turns(description, poses, frame)
        if not poses:
            drawn = {camera.id: camera.T_rig_camera for camera in description.cameras}
            poses = {camera_id: T for camera_id, T in drawn.items() if T is not None}
        return cls(
            turns, {camera_id: model.raw_model for camera_id, model in models.items()}, _tints(models, poses)
        )


def _tints(models: Mapping[int, CameraModel], poses: Mapping[int, Pose]) -> dict[int, Tint]:
    """Tints by camera id, where any other camera sees the same."""
    layers: dict[int, tuple[ImageU8, ImageU8]] = {}
    found = 0
    for i, j in combinations(sorted(models.keys() & poses.keys()), 2):
        color_i, color_j = models[i].color, models[j].color
        seen_in_i = seen_grid(color_i, color_j, inverse(poses[j]) @ poses[i])
        seen_in_j = seen_grid(color_j, color_i, inverse(poses[i]) @ poses[j])
        if not (seen_in_i.any() and seen_in_j.any()):
            continue
        hue = _bgr(_PAIR_HUES_DEG[found % len(_PAIR_HUES_DEG)])
        found += 1
        for camera, seen in ((i, seen_in_i), (j, seen_in_j)):
            colors, mask = layers.setdefault(
                camera, (np.zeros((*seen.shape, 3), np.uint8), np.zeros(seen.shape, np.uint8))
            )
            colors[seen] = hue
            mask[seen] = 255
    return {camera: Tint(*layer) for camera, layer in layers.items()}


def _bgr(hue_deg: int) -> ImageU8:
    pixel = np.array([[[hue_deg // 2, 210, 255]]], np.uint8)
    return np.asarray(cv2.cvtColor(pixel, cv2.COLOR_HSV2BGR)[0, 0], np.uint8)
