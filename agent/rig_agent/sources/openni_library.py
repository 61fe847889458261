"""OpenNI2 in this process: libOpenNI2 loaded and initialised, its devices listed and opened.

OpenNI2 has one context a process. It is initialised when a source opens and shut down when it closes, not
kept: FreenectDriver looks for Kinects only while it is being initialised.
"""

import ctypes
from pathlib import Path
from types import ModuleType
from typing import Any

from rig_agent.sources.base import SourceLost
from rig_protocol.errors import ConfigurationError, DataError, RigError
from rig_protocol.troubleshooting import Topic

# The second name comes with the development package alone.
_LIBRARY_NAMES = ("libOpenNI2.so.0", "libOpenNI2.so")
_DRIVERS = "/OpenNI2/Drivers/"
_SERIAL_PROPERTY = 3
_SERIAL_BYTES = 256

_loaded_from: str | None = None
"""Folder of the libOpenNI2 that this process has loaded; ctypes cannot unload it."""
_drivers: dict[str, ctypes.CDLL] = {}


def initialise(redist: Path | None) -> ModuleType:
    """The package `openni` with OpenNI2 initialised; its `unload` undoes it.

    `redist` is the folder of libOpenNI2; unset: the system's. ConfigurationError says what to install,
    RigError when another source of this process uses OpenNI2.
    """
    openni2 = _package()
    if openni2.is_initialized():
        raise RigError("this process uses an OpenNI2 device already: start one rig-agent for each device")
    _load(openni2, redist)
    try:
        openni2.initialize()
    except openni2.OpenNIError as error:
        raise ConfigurationError(
            f"OpenNI2 does not start ({reason(error)}): libOpenNI2 needs its drivers in OpenNI2/Drivers "
            "beside it; apt install libopenni2-0, or give the folder of both as `redist` in [openni2]",
            Topic.MISSING_LIBRARY,
        ) from error
    _keep_drivers_loaded()
    return openni2


def open_recording(openni2: ModuleType, path: Path) -> Any:
    """An .oni recording as a device; DataError when OpenNI2 cannot play it."""
    try:
        return openni2.Device(str(path.resolve()).encode())
    except openni2.OpenNIError as error:
        raise DataError(f"OpenNI2 cannot play {path}: {reason(error)}") from error


def open_device(openni2: ModuleType, uri: str | None, serial: str | None) -> Any:
    """The device with this URI or serial number, else the only one.

    SourceLost when it is absent or does not open, ConfigurationError when the choice is unclear.
    """
    present = [raw.decode(errors="replace") for raw in openni2.Device.enumerate_uris()]
    if uri is not None:
        return _open(openni2, uri, present)
    if not present:
        raise SourceLost(
            "OpenNI2 sees no device: check cable and power, and that OpenNI2/Drivers holds its driver "
            "(for a Kinect, libfreenect's FreenectDriver)",
            Topic.NO_KINECT,
        )
    if serial is not None:
        return _open_by_serial(openni2, serial, present)
    if len(present) > 1:
        raise ConfigurationError(
            f"OpenNI2 sees {len(present)} devices, {', '.join(present)}: give `uri` or `serial` in [openni2]"
        )
    return _open(openni2, present[0], present)


def serial_of(device: Any) -> str | None:
    """The serial number that the driver tells; None for one that tells none, as FreenectDriver."""
    if not device.is_property_supported(_SERIAL_PROPERTY):
        return None
    text = device.get_property(_SERIAL_PROPERTY, ctypes.c_char * _SERIAL_BYTES)
    return str(text.value.decode(errors="replace")) or None


def reason(error: Exception) -> str:
    """What OpenNI2 says went wrong, else its status, on one line."""
    status, said = error.args[:2] if len(error.args) > 1 else ("", str(error))
    text = said.decode(errors="replace") if isinstance(said, bytes) else said
    return " ".join(text.split()) or getattr(status, "name", str(status))


def _package() -> ModuleType:
    try:
        from openni import openni2
    except ImportError as error:
        raise ConfigurationError(
            "source openni2 needs the Python package openni: pip install 'kinect-rig[openni]'",
            Topic.MISSING_LIBRARY,
        ) from error
    module: ModuleType = openni2
    return module


def _load(openni2: Any, redist: Path | None) -> None:
    """Load libOpenNI2, once; not by the package's own search, which knows no Debian and changes folder."""
    global _loaded_from
    wanted = str(redist or "the system")
    if _loaded_from is not None:
        if wanted != _loaded_from:
            raise RigError(f"libOpenNI2 of {_loaded_from} is loaded: start the agent anew to use {wanted}")
        return
    folder = redist.resolve() if redist else Path()
    reasons = []
    for name in _LIBRARY_NAMES:
        try:
            openni2.c_api.load_dll(str(folder / name))
        except OSError as error:
            reasons.append(str(error))
        else:
            # Without it, `initialize` would search for a library of its own.
            openni2.loaded_dll_directory = _loaded_from = wanted
            return
    raise ConfigurationError(
        f"libOpenNI2 cannot be loaded ({reasons[0]}): apt install libopenni2-0, "
        "or give its folder as `redist` in [openni2]",
        Topic.MISSING_LIBRARY,
    )


def _keep_drivers_loaded() -> None:
    """Hold on to every driver: OpenNI2 unloads them, and each time OniFile's is loaded it leaks 9 KiB."""
    for line in Path("/proc/self/maps").read_text().splitlines():
        path = line.split(maxsplit=5)[-1]
        if _DRIVERS in path and path not in _drivers:
            _drivers[path] = ctypes.CDLL(path)


def _open(openni2: ModuleType, uri: str, present: list[str]) -> Any:
    try:
        return openni2.Device(uri.encode())
    except openni2.OpenNIError as error:
        if uri not in present:
            raise SourceLost(
                f"no OpenNI2 device {uri} is connected{_but(present)}: check its cable and power",
                Topic.NO_KINECT,
            ) from error
        raise SourceLost(
            f"{uri} cannot be opened ({reason(error)}): does another program use it, may this user?",
            Topic.KINECT_IN_USE,
        ) from error


def _open_by_serial(openni2: ModuleType, serial: str, present: list[str]) -> Any:
    """A driver tells a device's serial number only once it is open; wrong ones are closed again."""
    told = []
    for uri in present:
        try:
            device = openni2.Device(uri.encode())
            found = serial_of(device)
        except openni2.OpenNIError as error:
            told.append(f"{uri} ({reason(error)})")
            continue
        if found == serial:
            return device
        device.close()
        told.append(f"{uri} ({found or 'tells no serial number: choose it by `uri`'})")
    raise SourceLost(
        f"no OpenNI2 device {serial} is connected{_but(told)}: check its cable and power", Topic.NO_KINECT
    )


def _but(present: list[str]) -> str:
    return f", but {', '.join(present)}" if present else ""
