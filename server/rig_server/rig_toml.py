"""Changes to rig.toml that a program makes: comments, order and everything else stay."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import MutableMapping
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.items import AoT

from rig_protocol.errors import ConfigurationError
from rig_server.config import load_rig_settings


def assign_slot(
    file: Path, slot: int, serial: str | None, port_path: str | None = None, name: str | None = None
) -> list[str]:
    """Bind a slot to the camera with this serial number, or at this port; what was changed, in sentences.

    A slot that is not listed is added; a camera that another slot was bound to leaves that. The file is
    replaced in one step, and only by one that is valid: ConfigurationError otherwise.
    """
    load_rig_settings(file)  # what is wrong with it now is not our doing
    document = tomlkit.parse(file.read_text())
    cameras = document.setdefault("cameras", tomlkit.aot())
    told = [] if len(cameras) else ["from its next start on, the server takes only the cameras listed there"]
    told += _release(cameras, slot, serial)
    entry = next((one for one in cameras if one.get("id") == slot), None)
    if entry is None:
        entry = _added(cameras, slot)
        told.append(f"slot {slot} is new")
        if "expected_cameras" in document:
            document["expected_cameras"] = len(cameras)
    _bind(entry, {"serial": serial, "port_path": port_path})
    if name is not None:
        entry["name"] = name
    _replace(file, tomlkit.dumps(document))
    return told


def _release(cameras: Any, slot: int, serial: str | None) -> list[str]:
    """Take a serial number from another slot: a camera has one place."""
    if serial is None:
        return []
    others = [one for one in cameras if one.get("serial") == serial and one.get("id") != slot]
    for one in others:
        del one["serial"]
    return [f"slot {one.get('id')} has no camera now" for one in others]


def _added(cameras: Any, slot: int) -> MutableMapping[str, Any]:
    entry = tomlkit.table() if isinstance(cameras, AoT) else tomlkit.inline_table()
    entry["id"] = slot
    cameras.append(entry)
    added: MutableMapping[str, Any] = cameras[-1]
    return added


def _bind(entry: MutableMapping[str, Any], identity: dict[str, str | None]) -> None:
    for key, value in identity.items():
        if value is not None:
            entry[key] = value
        elif key in entry:
            del entry[key]


def _replace(file: Path, text: str) -> None:
    """Write beside the file, check, and take its place with the owner and mode that it had."""
    try:
        descriptor, beside = tempfile.mkstemp(prefix=f".{file.name}.", suffix=".toml", dir=file.parent)
    except OSError as error:
        raise ConfigurationError(f"{file} cannot be changed: {error.strerror}; use sudo") from error
    fresh = Path(beside)
    try:
        with os.fdopen(descriptor, "w") as stream:
            stream.write(text)
        load_rig_settings(fresh)
        shutil.copymode(file, fresh)
        with contextlib.suppress(PermissionError):  # only root gives files away
            os.chown(fresh, file.stat().st_uid, file.stat().st_gid)
        fresh.replace(file)
    except ConfigurationError as error:
        raise ConfigurationError(
            f"{file} is left as it was: {str(error).replace(str(fresh), 'it')}"
        ) from error
    except OSError as error:
        raise ConfigurationError(f"{file} cannot be changed: {error.strerror}; use sudo") from error
    finally:
        fresh.unlink(missing_ok=True)
