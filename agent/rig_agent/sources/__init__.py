"""The drivers of cameras, by name. A driver and its libraries are imported when it is opened."""

import importlib.util
from typing import TYPE_CHECKING

from rig_protocol.errors import ConfigurationError

if TYPE_CHECKING:  # settings know the drivers' options, so they import this package
    from rig_agent.config import AgentSettings
    from rig_agent.sources.base import FrameSource

_FOLDER_FPS = 30.0


def open_source(settings: "AgentSettings") -> "FrameSource":
    """Open the source that the settings name; errors are those of the driver."""
    return _OPENERS[settings.source](settings)


def _open_freenect(settings: "AgentSettings") -> "FrameSource":
    from rig_agent.sources.freenect import FreenectSource

    return FreenectSource(settings.freenect)


def _open_openni2(settings: "AgentSettings") -> "FrameSource":
    from rig_agent.sources.openni2 import Openni2Source

    return Openni2Source(settings.openni2)


def _open_folder(settings: "AgentSettings") -> "FrameSource":
    from rig_agent.sources.folder import FolderSource

    camera = settings.camera if settings.folder.camera is None else settings.folder.camera
    if settings.folder.path is None:
        raise ConfigurationError("source folder needs a folder: give --path, or `path` in [folder]")
    if camera is None:
        raise ConfigurationError("source folder plays one camera: give --camera, or `camera` in [folder]")
    return FolderSource(settings.folder.path, camera, settings.fps or _FOLDER_FPS)


def _open_recording(settings: "AgentSettings") -> "FrameSource":
    from rig_agent.sources.recording import RecordingSource

    camera = settings.camera if settings.recording.camera is None else settings.recording.camera
    if settings.recording.path is None:
        raise ConfigurationError("source recording needs a file: give --path, or `path` in [recording]")
    if camera is None:
        raise ConfigurationError(
            "source recording plays one camera: give --camera (or `camera` in [recording])"
        )
    missing = [name for name in ("mcap", "numba") if importlib.util.find_spec(name) is None]
    if missing:
        told = " and ".join(missing)
        raise ConfigurationError(f"source recording runs on a PC: {told} is missing, get kinect-rig[server]")
    return RecordingSource(settings.recording.path, camera)


def _open_synthetic(settings: "AgentSettings") -> "FrameSource":
    from rig_agent.sources.synthetic import SyntheticSource

    fps = settings.synthetic.fps if settings.fps is None else settings.fps
    return SyntheticSource(settings.synthetic.model_copy(update={"fps": fps}), settings.camera or 0)


_OPENERS = {
    "freenect": _open_freenect,
    "openni2": _open_openni2,
    "folder": _open_folder,
    "recording": _open_recording,
    "synthetic": _open_synthetic,
}
