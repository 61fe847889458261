"""What `--rig` tells of the cameras: a rig folder, its nominal.json, or a rig.toml with intrinsics files."""

import os
import tomllib
from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rig_protocol.camera import CameraModel
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.rig_folder import RigDescription, frame_indices, read_json, read_rig_description


@dataclass(frozen=True, slots=True, eq=False)
class KnownRig:
    """Models by camera id; names of colour images by camera id and panoramic frame, below `image_folder`."""

    models: Mapping[int, CameraModel] = field(default_factory=dict)
    images: Mapping[int, Mapping[int, str]] = field(default_factory=dict)
    image_folder: Path | None = None

    def image_root_from(self, folder: Path) -> str:
        """The image folder as seen from another folder, with slashes."""
        if self.image_folder is None:
            return "."
        return Path(os.path.relpath(self.image_folder, folder)).as_posix()

    def left_out(self, placed: Container[int]) -> list[str]:
        """A sentence about the cameras that are known and not placed, if there are any."""
        missing = [str(camera) for camera in self.models if camera not in placed]
        return (
            [f"not placed by the calibration, so left out: cameras {', '.join(missing)}"] if missing else []
        )


def read_known_rig(path: Path, frames: int) -> KnownRig:
    """Read any of the three; of the images of a folder those of the first `frames` panoramic frames.

    ConfigurationError when there is nothing to read, DataError when it is torn.
    """
    if path.suffix == ".toml":
        return KnownRig(_models_of_toml(path))
    description = read_rig_description(path)
    folder = path if path.is_dir() else path.parent
    models = {camera.id: camera.model for camera in description.cameras}
    return KnownRig(models, _images(folder, description, frames), folder)


def _images(folder: Path, description: RigDescription, frames: int) -> dict[int, dict[int, str]]:
    held = {
        camera.id: frame_indices(folder, camera.name)
        for camera in description.cameras
        if (folder / camera.name).is_dir()
    }
    first = sorted({index for own in held.values() for index in own})[:frames]
    return {
        camera.id: {
            index: f"{camera.name}/color_{index:03d}.png"
            for index in first
            if index in held.get(camera.id, ())
        }
        for camera in description.cameras
    }


def _models_of_toml(path: Path) -> dict[int, CameraModel]:
    """Models of the cameras that name an intrinsics file; the rest of rig.toml is the server's affair."""
    try:
        cameras: list[dict[str, Any]] = tomllib.loads(path.read_text()).get("cameras", [])
        files = {int(c["id"]): path.parent / str(c["intrinsics"]) for c in cameras if c.get("intrinsics")}
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read: {error.strerror}") from error
    except (AttributeError, KeyError, TypeError, ValueError) as error:  # broken TOML is a ValueError
        raise ConfigurationError(f"{path} is not a rig.toml: {error}") from error
    models = {}
    for camera, file in files.items():
        try:
            models[camera] = CameraModel.from_dict(read_json(file))
        except DataError as error:
            raise ConfigurationError(f"intrinsics file {file}: {error}") from error
    return models
