"""Depth cameras made of files, under the unmodified libOpenNI2: the C++ driver beside this file.

A folder of devices holds one named folder for each. In it, the test writes
    present                    exists while the device is plugged in
    depth.bin, color.bin       images, looped: 640×480 little-endian u16; RGB bytes; absent: no such sensor
    registered.bin             what depth.bin becomes when depth is registered to colour; absent: cannot be
    serial                     absent: the device tells none, as FreenectDriver's
    depth_unit                 1mm or 100um
    clock, first_tick          us or ticks (60 MHz, 32 bits); what it stands at when the device is opened
    mirror                     images are mirrored unless switched off; with the text `always`, always
    no_fov, deny, stall        tells no field of view; cannot be opened; sends no images
and the driver appends to `log` what it was asked. Environment: RIG_OPENNI_DIR is the folder of devices,
RIG_OPENNI_FPS their frame rate (30).
"""

import ctypes.util
import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

_SOURCES = Path(__file__).parent
_HEADERS = Path("/usr/include/openni2")
_LIBRARY = "libOpenNI2.so.0"
_PLAYER = "OpenNI2/Drivers/libOniFile.so.0"
_DRIVER = "OpenNI2/Drivers/libRigVirtual.so.0"
_INSTALL = "apt install libopenni2-0 libopenni2-dev g++, and pip install openni"
_SHAPE = (480, 640)


@dataclass(frozen=True)
class DeviceImages:
    """What a device loops; colour and depth of one index belong together."""

    color_rgb: npt.NDArray[np.uint8]  # (N,480,640,3)
    depth: npt.NDArray[np.uint16]  # (N,480,640)
    registered: npt.NDArray[np.uint16]  # (N,480,640)

    def index_of(self, color_bgr: npt.NDArray[np.uint8]) -> int | None:
        """Which colour image this is, byte for byte."""
        rgb = color_bgr[:, :, ::-1]
        return next((i for i, image in enumerate(self.color_rgb) if np.array_equal(image, rgb)), None)

    def depth_index_of(self, depth_mm: npt.NDArray[np.uint16]) -> int | None:
        """Which depth image this is, byte for byte."""
        return next((i for i, image in enumerate(self.depth) if np.array_equal(image, depth_mm)), None)


@functools.cache
def device_images(count: int = 6) -> DeviceImages:
    """Random images, no two alike; a tenth of the depth is missing."""
    rng = np.random.default_rng(7)
    depth = rng.integers(400, 8000, (2, count, *_SHAPE), dtype=np.uint16)
    depth[rng.random(depth.shape, dtype=np.float32) < 0.1] = 0
    return DeviceImages(rng.integers(0, 256, (count, *_SHAPE, 3), dtype=np.uint8), depth[0], depth[1])


class VirtualDevice:
    """One device's folder."""

    def __init__(self, folder: Path) -> None:
        """Make it."""
        self.folder = folder
        folder.mkdir()

    @property
    def uri(self) -> str:
        """As the driver names it."""
        return f"virtual://{self.folder.name}"

    def plug(self) -> None:
        """It appears."""
        self.write("present")

    def unplug(self) -> None:
        """It is gone."""
        self.clear("present")

    def write(self, name: str, content: str | bytes = "") -> None:
        """Set a value or switch a fault on."""
        (self.folder / name).write_bytes(content.encode() if isinstance(content, str) else content)

    def clear(self, name: str) -> None:
        """Take a value back or switch a fault off."""
        (self.folder / name).unlink(missing_ok=True)

    def log(self) -> list[str]:
        """What the driver was asked, one line each."""
        path = self.folder / "log"
        return path.read_text().splitlines() if path.exists() else []


class VirtualDevices:
    """A folder of devices; empty at first."""

    def __init__(self, folder: Path, fps: float = 30.0) -> None:
        """Make it."""
        self.folder, self.fps = folder, fps
        folder.mkdir(exist_ok=True)

    def add(
        self, name: str = "a", images: DeviceImages | None = None, *, plugged: bool = True
    ) -> VirtualDevice:
        """A device with both sensors that registers depth and whose serial number is `SN-` and its name."""
        device = VirtualDevice(self.folder / name)
        images = images or device_images()
        device.write("depth.bin", images.depth.astype("<u2").tobytes())
        device.write("registered.bin", images.registered.astype("<u2").tobytes())
        device.write("color.bin", images.color_rgb.tobytes())
        device.write("serial", f"SN-{name}")
        if plugged:
            device.plug()
        return device

    @property
    def variables(self) -> dict[str, str]:
        """The driver's environment."""
        return {"RIG_OPENNI_DIR": str(self.folder), "RIG_OPENNI_FPS": str(self.fps)}

    def environment(self, base: Mapping[str, str] | None = None) -> dict[str, str]:
        """The environment in which a child process finds these devices."""
        return {**(os.environ if base is None else base), **self.variables}


@functools.cache
def redist() -> Path:
    """A folder with the system's libOpenNI2, its player of recordings and the driver of virtual devices.

    Built once for these sources; skips when it cannot be built.
    """
    library = _system_library()
    if library is None or not _HEADERS.exists() or shutil.which("g++") is None or find_spec("openni") is None:
        pytest.skip(f"virtual OpenNI2 devices need libOpenNI2, its headers, a compiler, openni: {_INSTALL}")
    sources = sorted(_SOURCES.glob("*.[ch]pp"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"kinect-rig-openni-{os.getuid()}-{digest}"
    if not (folder / _DRIVER).exists():
        folder.mkdir(mode=0o700, exist_ok=True)
        (folder / _DRIVER).parent.mkdir(parents=True, exist_ok=True)
        _link(folder / _LIBRARY, library)
        _link(folder / _PLAYER, library.parent / _PLAYER)
        _compile([path for path in sources if path.suffix == ".cpp"], folder / _DRIVER)
    return folder


def _system_library() -> Path | None:
    """Where the system's libOpenNI2 lies; None when it, or its player of recordings, is not installed."""
    if ctypes.util.find_library("OpenNI2") is None:
        return None
    places = [*Path("/usr/lib").glob("*-linux-gnu*"), Path("/usr/lib"), Path("/usr/local/lib")]
    whole = (place for place in places if (place / _LIBRARY).exists() and (place / _PLAYER).exists())
    return next((place / _LIBRARY for place in whole), None)


def _link(link: Path, target: Path) -> None:
    scratch = link.with_suffix(f".{os.getpid()}")  # test workers may do this at the same time
    scratch.symlink_to(target)
    scratch.rename(link)


def _compile(sources: list[Path], target: Path) -> None:
    scratch = target.with_suffix(f".{os.getpid()}.tmp")
    options = [
        "-std=c++17",
        "-O2",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-fPIC",
        "-shared",
        "-isystem",
        str(_HEADERS),
    ]
    subprocess.run(["g++", *options, *map(str, sources), "-o", str(scratch), "-lpthread"], check=True)
    scratch.rename(target)
