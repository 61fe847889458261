"""The formats that `rig-calib export` writes frames in."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from rig_calib.frame_exports.job import Exporter
from rig_protocol.errors import ConfigurationError


@dataclass(frozen=True, slots=True)
class FrameFormat:
    """A module of this package that has `export`; `suffix` of the one file, or None where it is a folder.

    `per_frame`: a folder of such files, one a panoramic frame, or one such file of a single frame.
    `extra`: the one of kinect-rig that its library comes with.
    """

    module: str
    suffix: str | None
    extra: str = "exports"
    per_frame: bool = False

    def check(self, out: Path, frames: int) -> None:
        """ConfigurationError where `out` is one file, and would have to hold several frames' files."""
        if self.per_frame and frames > 1 and out.suffix == self.suffix:
            raise ConfigurationError(
                f"{out} is one file, and each of {frames} panoramic frames makes one: name a folder, or "
                "choose one frame with --frames 1"
            )

    def exporter(self) -> Exporter:
        """Its function; ConfigurationError names the extra where its library is not installed."""
        try:
            exporter: Exporter = import_module(f"rig_calib.frame_exports.{self.module}").export
        except ModuleNotFoundError as error:
            raise ConfigurationError(
                f"this format needs the Python package {error.name}: pip install 'kinect-rig[{self.extra}]'"
            ) from error
        return exporter


FORMATS: Mapping[str, FrameFormat] = {
    "foxglove": FrameFormat("foxglove", ".mcap"),
    "rerun": FrameFormat("rerun", ".rrd", extra="rerun"),
    "tum": FrameFormat("tum", None),
    "rig-folder": FrameFormat("rig_folder", None),
    "ply": FrameFormat("ply", ".ply", per_frame=True),
    "pcd": FrameFormat("pcd", ".pcd", per_frame=True),
    "e57": FrameFormat("e57", ".e57", per_frame=True),
    "las": FrameFormat("las", ".las", per_frame=True),
    "png": FrameFormat("png", None),
    "exr": FrameFormat("exr", ".exr", per_frame=True),
    "video": FrameFormat("video", ".mp4"),
}
