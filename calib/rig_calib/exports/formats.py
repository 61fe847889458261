"""The formats that `rig-calib export` knows, and their files on disk."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from rig_calib.exports import colmap, kalibr, nerfstudio, opencv_yaml, ros2
from rig_calib.exports.exported_rig import Export, ExportedRig
from rig_calib.whole_file import whole_file
from rig_protocol.errors import ConfigurationError


@dataclass(frozen=True, slots=True)
class Format:
    """How a rig becomes files; `file` names the only one, or is None where a folder is written."""

    export: Callable[[ExportedRig], Export]
    file: str | None


FORMATS: Mapping[str, Format] = {
    "kalibr": Format(kalibr.export, kalibr.FILE),
    "ros2": Format(ros2.export_launch, ros2.LAUNCH_FILE),
    "urdf": Format(ros2.export_urdf, ros2.URDF_FILE),
    "colmap": Format(colmap.export, None),
    "nerfstudio": Format(nerfstudio.export, nerfstudio.FILE),
    "opencv": Format(opencv_yaml.export, opencv_yaml.FILE),
}


def find_format(name: str) -> Format:
    """The format of this name; ConfigurationError lists those that there are."""
    if name not in FORMATS:
        raise ConfigurationError(f"format {name!r} is none of {', '.join(FORMATS)}")
    return FORMATS[name]


def target_folder(form: Format, out: Path) -> Path:
    """The folder that the files of an export to `out` come into."""
    return out if form.file is None or _is_folder(out) else out.parent


def write_export(form: Format, export: Export, out: Path) -> list[Path]:
    """Write the files to `out`: a folder, or for a format of one file that file.

    RigError when they cannot be written.
    """
    folder = target_folder(form, out)
    written = []
    for name, text in export.files.items():
        path = folder / name if folder == out else out
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigurationError(f"cannot write to {path.parent}: {error.strerror}") from error
        with whole_file(path) as file:
            file.write(text.encode())
        written.append(path)
    return written


def _is_folder(out: Path) -> bool:
    return out.is_dir() or not out.suffix
