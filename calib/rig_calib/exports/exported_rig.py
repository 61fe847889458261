"""What an export is made of, and what reading one gives back: cameras, poses, intrinsics, images."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rig_calib.rig_calibration import RigCalibration
from rig_protocol.camera import CameraModel, Intrinsics
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.poses import Pose


@dataclass(frozen=True, slots=True, eq=False)
class ExportedCamera:
    """One unit: T_rig_camera of its colour camera (OpenCV axes), and what is known of both cameras.

    `images`: names of its colour images by panoramic frame, relative to the rig's `image_root`.
    """

    name: str
    T_rig_camera: Pose
    color: Intrinsics | None = None
    depth: Intrinsics | None = None
    T_color_depth: Pose | None = None
    images: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class ExportedRig:
    """Cameras in a fixed order; `overlaps` pairs their positions in it, not their ids."""

    cameras: tuple[ExportedCamera, ...]
    overlaps: tuple[tuple[int, int], ...] = ()
    image_root: str = "."

    def colors(self) -> list[Intrinsics]:
        """Colour intrinsics of every camera; ConfigurationError names those without."""
        missing = [camera.name for camera in self.cameras if camera.color is None]
        if missing:
            raise ConfigurationError(
                f"this format needs intrinsics, and none are known of {', '.join(missing)}: give --rig with "
                "the rig folder, or a rig.toml whose cameras name intrinsics files (rig-calib intrinsics)"
            )
        return [camera.color for camera in self.cameras if camera.color is not None]

    def ros_names(self) -> list[str]:
        """Names of the cameras as ROS allows them: letters, digits, underscores, each once."""
        return ros_names([camera.name for camera in self.cameras])


def ros_names(names: Sequence[str]) -> list[str]:
    """The names as ROS allows them: letters, digits, underscores, each once."""
    allowed: list[str] = []
    for n, own in enumerate(names):
        name = re.sub(r"[^A-Za-z0-9_]", "_", own)
        allowed.append(name if name not in allowed else f"{name}_{n}")
    return allowed


@dataclass(frozen=True, slots=True)
class Export:
    """Text by file name, and what the user should know about it."""

    files: Mapping[str, str]
    notes: Sequence[str] = ()


def exported_rig(
    calibration: RigCalibration,
    models: Mapping[int, CameraModel],
    images: Mapping[int, Mapping[int, str]] | None = None,
    image_root: str = ".",
) -> ExportedRig:
    """The placed cameras of a calibration in the order of their ids.

    `models` decides what intrinsics are exported; `images`: camera id -> panoramic frame -> image name.
    DataError when the calibration placed no camera, or two share a name.
    """
    placed = sorted(calibration.cameras, key=lambda camera: camera.id)
    if not placed:
        raise DataError("the calibration places no camera: there is nothing to export")
    if len({camera.name for camera in placed}) < len(placed):
        raise DataError(
            "two cameras of the calibration share a name, which is how other programs tell them apart"
        )
    cameras = []
    for camera in placed:
        model = models.get(camera.id)
        shown = {} if images is None else images.get(camera.id, {})
        if model is None:
            cameras.append(ExportedCamera(camera.name, camera.T_rig_camera, images=shown))
            continue
        cameras.append(
            ExportedCamera(
                camera.name, camera.T_rig_camera, model.color, model.depth, model.T_color_depth, shown
            )
        )
    position = {camera.id: index for index, camera in enumerate(placed)}
    overlaps = tuple(
        (position[edge.i], position[edge.j])
        for edge in calibration.edges
        if edge.used and edge.i in position and edge.j in position
    )
    return ExportedRig(tuple(cameras), overlaps, image_root)
