"""The libraries that the agent's source needs, and their versions."""

import ctypes
import importlib.metadata
import platform
import re
from pathlib import Path

from rig_agent.config import AgentSettings
from rig_agent.doctor.finding import Check, Finding, failed, ok
from rig_agent.doctor.machine import Machine
from rig_protocol.errors import ConfigurationError
from rig_protocol.troubleshooting import Topic

_DISTRIBUTION = "kinect-rig"
_OPENNI2_NAMES = ("libOpenNI2.so.0", "libOpenNI2.so")
_OF_ALL = re.compile(r"([A-Za-z0-9._-]+)[^;]*(?:;\s*extra == ['\"]agent['\"])?$")


class _LibusbVersion(ctypes.Structure):
    """`struct libusb_version`, as far as it is read."""

    _fields_ = (("major", ctypes.c_uint16), ("minor", ctypes.c_uint16), ("micro", ctypes.c_uint16))


def libraries(machine: Machine, settings: AgentSettings) -> list[Finding]:
    """Python's packages, and those of the driver."""
    found = [_python()]
    if settings.source == "freenect":
        found += [_libusb(machine), _libfreenect(machine, settings)]
    if settings.source == "openni2":
        found.append(_openni2(machine, settings))
    return found


def _python() -> Finding:
    said = f"Python {platform.python_version()}"
    try:
        said = f"{_DISTRIBUTION} {importlib.metadata.version(_DISTRIBUTION)}, {said}"
        wanted = importlib.metadata.requires(_DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        wanted = []
    names = [match.group(1) for line in wanted if (match := _OF_ALL.match(line))]
    missing = [name for name in names if not _is_installed(name)]
    if missing:
        return failed(
            Check.PYTHON,
            f"{said}: {', '.join(missing)} not installed",
            "sudo /opt/kinect-rig/current/bin/pip install 'kinect-rig[agent]'",
            Topic.MISSING_LIBRARY,
        )
    return ok(Check.PYTHON, f"{said}, all {len(names)} packages")


def _is_installed(name: str) -> bool:
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def _libusb(machine: Machine) -> Finding:
    try:
        library = machine.load_library("libusb-1.0.so.0")
    except OSError as error:
        mend = "sudo apt install libusb-1.0-0"
        return failed(Check.LIBUSB, f"libusb cannot be loaded: {error}", mend, Topic.MISSING_LIBRARY)
    library.libusb_get_version.restype = ctypes.POINTER(_LibusbVersion)
    version = library.libusb_get_version().contents
    return ok(Check.LIBUSB, f"libusb {version.major}.{version.minor}.{version.micro}")


def _libfreenect(machine: Machine, settings: AgentSettings) -> Finding:
    try:
        machine.load_libfreenect(settings.freenect.library)
    except ConfigurationError as error:
        mend = "sudo apt install libfreenect0.5"
        return failed(Check.LIBFREENECT, str(error), mend, Topic.MISSING_LIBRARY)
    loaded = re.search(r"/\S*libfreenect\.so\S*", machine.text("/proc/self/maps") or "")
    path = str(machine.path(loaded.group()).resolve()) if loaded else "libfreenect"
    version = path.rpartition(".so.")[2] if loaded else "(version unknown)"
    return ok(Check.LIBFREENECT, f"libfreenect {version} at {path}")


def _openni2(machine: Machine, settings: AgentSettings) -> Finding:
    if not _is_installed("openni"):
        mend = "sudo /opt/kinect-rig/current/bin/pip install 'kinect-rig[openni]'"
        return failed(
            Check.OPENNI2, "the Python package openni is not installed", mend, Topic.MISSING_LIBRARY
        )
    folder, reasons = settings.openni2.redist or Path(), []
    for name in _OPENNI2_NAMES:
        try:
            machine.load_library(str(folder / name))
        except OSError as error:
            reasons.append(str(error))
        else:
            return ok(Check.OPENNI2, f"OpenNI2 as {name}")
    text = f"libOpenNI2 cannot be loaded: {reasons[0]}"
    return failed(Check.OPENNI2, text, "sudo apt install libopenni2-0", Topic.MISSING_LIBRARY)
