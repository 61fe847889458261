"""A rig folder read as panoramic frames."""

from collections import deque
from collections.abc import Mapping
from pathlib import Path

from rig_calib.rig_calibration import RigCalibration
from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.frames import PanoramicFrame
from rig_protocol.messages import Hello
from rig_protocol.rig_folder import RigDescription, frame_indices, read_frame, read_rig_description
from rig_server.metrics import CameraMetrics, RigStatus
from rig_server.unattended import Unattended


class RecordedRig(Unattended):
    """The panoramic frames of a rig folder, once, in the order of their indices.

    ConfigurationError when there is no such folder, or no frame in it; DataError when a file is malformed.
    """

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise ConfigurationError(f"{folder} is no folder: a rig folder holds nominal.json and cam00, ...")
        self._folder = folder
        self.calibration: RigCalibration | None = None
        self.description: RigDescription = read_rig_description(folder)
        self._indices = {
            camera.id: frozenset(frame_indices(folder, camera.name)) for camera in self.description.cameras
        }
        self._coming = deque(sorted(frozenset[int]().union(*self._indices.values())))
        self._complete = self._partial = 0
        if not self._coming:
            raise ConfigurationError(f"{folder} holds no frames (color_000.png, ...)")

    @property
    def source(self) -> str:
        """For the provenance of a result."""
        return "folder"

    @property
    def place(self) -> str:
        """Where the frames come from, in words."""
        return f"rig folder {self._folder}"

    @property
    def hellos(self) -> Mapping[int, Hello]:
        """No agent is involved."""
        return {}

    @property
    def ended(self) -> bool:
        """True when every index was read."""
        return not self._coming

    def start(self) -> None:
        """A folder is always there."""

    def end_sets(self) -> None:
        """Nothing is open between two frames."""

    def stop(self) -> None:
        """Nothing is open between two frames."""

    def absence(self) -> None:
        """Every camera of the folder is here."""

    def next_panorama(self, timeout_s: float) -> PanoramicFrame | None:  # noqa: ARG002  # files do not wait
        """The panoramic frame of the next index; a camera without this index is missing from it."""
        if self.ended:
            return None
        panorama = self._panorama(self._coming.popleft())
        self._complete += panorama.complete
        self._partial += not panorama.complete
        return panorama

    def start_recording(self, take: Path) -> None:
        """What was captured already is not recorded again: RigError."""
        raise RigError(f"{self.place} is a recording: copy it instead of recording {take}")

    def stop_recording(self) -> None:
        """Nobody records."""

    def status(self) -> RigStatus:
        """Cameras and sets read so far; a recording has no rates."""
        cameras = (CameraMetrics(c.id, c.name, connected=True) for c in self.description.cameras)
        return RigStatus(tuple(cameras), self._complete, self._partial)

    def _panorama(self, index: int) -> PanoramicFrame:
        frames = {
            camera.id: read_frame(self._folder, camera, index) if index in self._indices[camera.id] else None
            for camera in self.description.cameras
        }
        return PanoramicFrame.of(index, frames)
