"""A file that appears whole or not at all."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from rig_protocol.errors import RigError
from rig_protocol.troubleshooting import Topic


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """Open `path` for writing bytes; it takes the place of an older file when the block ends well.

    RigError when it cannot be written (a full disk); nothing of it is left then.
    """
    with whole_path(path) as part, part.open("wb") as file:
        yield file


@contextmanager
def whole_path(path: Path) -> Iterator[Path]:
    """As `whole_file`, for a library that opens the file itself: the path to give it."""
    part = path.with_name(path.name + ".part")
    try:
        yield part
        part.replace(path)
    except OSError as error:
        raise RigError(f"{path} could not be written: {error.strerror}", Topic.FULL_DISK) from error
    finally:
        part.unlink(missing_ok=True)
