"""The formats that `rig-calib export` writes frames in."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module

from rig_calib.frame_exports.job import Exporter
from rig_protocol.errors import ConfigurationError


@dataclass(frozen=True, slots=True)
class FrameFormat:
    """A module of this package that has `export`; `suffix` of the one file, or None where it is a folder."""

    module: str
    suffix: str | None

    def exporter(self) -> Exporter:
        """Its function; ConfigurationError names the extra where its library is not installed."""
        try:
            exporter: Exporter = import_module(f"rig_calib.frame_exports.{self.module}").export
        except ModuleNotFoundError as error:
            raise ConfigurationError(
                f"this format needs the Python package {error.name}: pip install 'kinect-rig[exports]'"
            ) from error
        return exporter


FORMATS: Mapping[str, FrameFormat] = {}
