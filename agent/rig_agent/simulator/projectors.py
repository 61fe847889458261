"""The light of the simulated Kinects' projectors in one room: who has switched its own off.

Real Kinects notice each other's light by seeing it. Simulated ones, in processes of their own, leave a file
in a common folder while their projector is dark.
"""

from collections.abc import Iterable
from pathlib import Path

from rig_protocol.errors import ConfigurationError


class ProjectorLights:
    """The projectors of one room, seen from the Kinect of one slot; without a folder all shine."""

    def __init__(self, folder: Path | None, camera: int) -> None:
        """This Kinect's projector shines; ConfigurationError when there is no such folder."""
        if folder is not None and not folder.is_dir():
            raise ConfigurationError(f"projector_folder {folder} is no folder: make one for the whole ring")
        self._folder, self._camera = folder, camera
        self.shine(True)

    def shine(self, on: bool) -> None:
        """Switch this Kinect's own."""
        if self._folder is None:
            return
        mark = _mark(self._folder, self._camera)
        if on:
            mark.unlink(missing_ok=True)
        else:
            mark.touch()

    def dark(self, cameras: Iterable[int]) -> frozenset[int]:
        """Which of these do not shine now."""
        if self._folder is None:
            return frozenset()
        return frozenset(camera for camera in cameras if _mark(self._folder, camera).exists())


def _mark(folder: Path, camera: int) -> Path:
    return folder / f"projector{camera:02d}.dark"
