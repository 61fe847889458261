"""The file that holds the rig's key: written readable by its owner alone, refused when others can read it."""

import contextlib
import logging
import os
import stat
from pathlib import Path

from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.rig_key import RigKey
from rig_protocol.troubleshooting import Topic

_log = logging.getLogger(__name__)

KEY_PLACES = (Path("rig.key"), Path("/etc/kinect-rig/rig.key"))
_OWNER_ONLY = 0o600
_MAX_BYTES = 1024  # a key file has 62


def rig_key(file: Path | None, insecure: bool) -> RigKey:
    """The key to use: of `file`, else of the first of KEY_PLACES that exists; the public one where insecure.

    ConfigurationError says what to do when there is none, or when it is not safe.
    """
    if insecure:
        if file is not None:
            raise ConfigurationError(f"`insecure` and the key file {file} exclude each other: drop one")
        _log.warning(
            "INSECURE: anybody on this network can watch, join and forge; only for an isolated bench"
        )
        return RigKey.INSECURE
    found = file or next((place for place in KEY_PLACES if _may_exist(place)), None)
    if found is None:
        raise ConfigurationError(
            "this rig has no key: run `rig-server keygen` on the PC and copy rig.key to "
            f"{KEY_PLACES[-1]} on every machine (or run all of them with --insecure on an isolated bench)",
            Topic.RIG_KEY,
        )
    return read_key(found)


def has_key(file: Path | None) -> bool:
    """Whether a key is named, or stands in one of KEY_PLACES."""
    return file is not None or any(map(_may_exist, KEY_PLACES))


def _may_exist(place: Path) -> bool:
    """True also where the folder is closed to us: reading the file then says so."""
    try:
        return place.exists()
    except PermissionError:
        return True


def read_key(path: Path) -> RigKey:
    """The key in a file that only its owner can read; ConfigurationError otherwise."""
    try:
        with path.open("rb") as file:
            mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
            content = file.read(_MAX_BYTES)
    except OSError as error:
        raise ConfigurationError(
            f"key file {path} cannot be read: {error.strerror}", Topic.RIG_KEY
        ) from error
    if mode & ~_OWNER_ONLY:
        raise ConfigurationError(
            f"key file {path} has mode {mode:04o}, others may read or change it: chmod 600 {path}; "
            "if anybody did, make a new key with `rig-server keygen --force`",
            Topic.RIG_KEY,
        )
    try:
        return RigKey.parse(content.decode("ascii"))
    except (DataError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"key file {path}: {error}", Topic.RIG_KEY) from error


def write_key(path: Path, key: RigKey, force: bool = False) -> None:
    """Write a key to `path`, whole or not at all, with mode 0600 from the first byte on.

    ConfigurationError when there is one already (unless `force`) or the place cannot be written.
    """
    if path.exists() and not force:
        raise ConfigurationError(
            f"{path} exists: a new key locks out every machine that holds the old one; "
            "--force makes it anyway"
        )
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _OWNER_ONLY)
        with os.fdopen(descriptor, "w") as file:
            os.fchmod(file.fileno(), _OWNER_ONLY)
            file.write(key.to_text())
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):  # where nothing can be written, nothing can be removed either
            fresh.unlink()
        raise ConfigurationError(f"{path} cannot be written: {error.strerror}") from error
