"""A folder that appears whole or not at all."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.troubleshooting import Topic


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """A folder to write into, which becomes `path` when the block ends well.

    ConfigurationError where `path` holds something already: a folder is never mixed with an older one.
    RigError when it cannot be written (a full disk); nothing of it is left then.
    """
    refuse_existing(path)
    part = path.with_name(path.name + ".part")
    try:
        shutil.rmtree(part, ignore_errors=True)  # what a kill left of an earlier try
        part.mkdir(parents=True)
        yield part
        if path.is_dir():
            path.rmdir()
        part.replace(path)
    except OSError as error:
        raise RigError(f"{path} could not be written: {error.strerror}", Topic.FULL_DISK) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def refuse_existing(path: Path) -> None:
    """ConfigurationError where there is a file, or a folder that is not empty, or one without a name."""
    if not path.name:
        raise ConfigurationError(f"{path} has no name: name what is to be made with --out")
    if path.is_file() or (path.is_dir() and any(path.iterdir())):
        raise ConfigurationError(f"{path} exists and stays as it is: name another with --out, or remove it")
