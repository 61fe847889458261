"""A USB bus full of virtual Kinects: the C library beside this file in libusb's place, driven by folders.

A bus is a folder with one numbered folder (0 to 7) for each Kinect. In it, the test writes
    present                            exists while the Kinect is plugged in
    serial, model                      model is 1414, 1473 or k4w
    bayer.bin, depth11.bin             frames, looped: 640×480 GRBG bytes; 640×480 packed 11-bit values
    ir.bin, bayer_high.bin, ir_high.bin   likewise, where a test wants them: 640×488 packed 10-bit values of
                                       infrared; 1280×1024 of either, at a third and a fourth of the rate
    accel                              "x y z tilt status" in counts (819 a g)
    first_tick                         the 60-MHz clock at power-on
    deny, busy, mute, stall            faults: no permission; claimed by another program; never answers
                                       (a USB reset cures it); sends no images
    mute_motor                         fault: the motor, and so the accelerometer, never answers
    no_firmware                        1473 and k4w: the audio device's boot loader runs, which has no motor;
                                       written before plugging
    audio_fault                        magic, tag, status or short: what is wrong with its acknowledgements
    deaf_sensor                        fault: the colour sensor takes no exposure and white balance
    lose                               percent of image packets lost at random
    lose_video_packet, …_depth_…       "p n": packet p of every n-th frame is lost
and the library appends to `log` what the driver commanded. Environment: VKINECT_DIR is the bus,
VKINECT_FPS its frame rate (30; at most 32).
"""

import ctypes
import ctypes.util
import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from support.real_data import real_data

_SOURCES = Path(__file__).parent
_SONAME = "libusb-1.0.so.0"
_HEADERS = ("/usr/include/libusb-1.0", "/usr/local/include/libusb-1.0")
_INSTALL = "apt install libfreenect0.5 libusb-1.0-0-dev gcc"


@dataclass(frozen=True)
class KinectFrames:
    """Frames that a virtual Kinect loops; colour and depth of one index belong together."""

    bayer: npt.NDArray[np.uint8]  # (N,480,640) GRBG
    raw: npt.NDArray[np.uint16]  # (N,480,640) 11-bit disparity

    @functools.cached_property
    def packed_raw(self) -> bytes:
        """The depth images as the sensor sends them."""
        return pack_bits(self.raw, bits=11)

    def index_of(self, raw: npt.NDArray[np.uint16]) -> int | None:
        """Which frame this depth image is, byte for byte."""
        return next((i for i, expected in enumerate(self.raw) if np.array_equal(expected, raw)), None)


@functools.cache
def kinect_frames() -> KinectFrames:
    """Recorded depth of a real Kinect and Bayer images of its colour camera, no two alike."""
    folder = real_data("kinect_v1_raw")
    raw = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted(folder.glob("raw_*.png"))]
    color = cv2.imread(str(folder / "pair_color.png"), cv2.IMREAD_COLOR)
    # An even shift keeps the mosaic's phase, and tells the frames apart.
    bayer = [np.roll(_mosaic_grbg(color), 2 * i, axis=1) for i in range(len(raw))]
    return KinectFrames(np.stack(bayer), np.stack(raw).astype(np.uint16))


@dataclass(frozen=True)
class InfraredFrames:
    """Infrared images that a virtual Kinect loops: ten bits a pixel, the upper eight as given here."""

    grey: npt.NDArray[np.uint8]  # (N,488,640)
    high: npt.NDArray[np.uint8]  # (N,1024,1280)

    def write(self, kinect: "VirtualKinect") -> None:
        """Before the Kinect is plugged in."""
        for name, images in (("ir.bin", self.grey), ("ir_high.bin", self.high)):
            (kinect.folder / name).write_bytes(pack_bits(images.astype(np.uint16) << 2, bits=10))


@functools.cache
def infrared_frames() -> InfraredFrames:
    """Noise, no two images alike."""
    random = np.random.default_rng(0)
    return InfraredFrames(
        random.integers(0, 256, (3, 488, 640), np.uint8), random.integers(0, 256, (2, 1024, 1280), np.uint8)
    )


class VirtualKinect:
    """One folder of the bus."""

    def __init__(self, folder: Path, serial: str, model: str, frames: KinectFrames) -> None:
        self.folder, self.serial, self.model = folder, serial, model
        folder.mkdir()
        self.write("serial", serial)
        self.write("model", model)
        (folder / "bayer.bin").write_bytes(frames.bayer.tobytes())
        (folder / "depth11.bin").write_bytes(frames.packed_raw)

    @property
    def port_path(self) -> str:
        """Where the camera is plugged in, as the kernel writes it."""
        return f"1-{int(self.folder.name) + 1}.1"

    def plug(self) -> None:
        """Power on; the device clock starts."""
        self.write("present")

    def unplug(self) -> None:
        """Power off."""
        self.clear("present")

    def write(self, name: str, text: str = "") -> None:
        """Set a value or switch a fault on."""
        (self.folder / name).write_text(text)

    def clear(self, name: str) -> None:
        """Take a value back or switch a fault off."""
        (self.folder / name).unlink(missing_ok=True)

    def log(self) -> list[str]:
        """What the driver commanded, one line each."""
        path = self.folder / "log"
        return path.read_text().splitlines() if path.exists() else []

    def open_handles(self) -> int:
        """USB handles that were opened and not closed again."""
        log = self.log()
        return sum(line.startswith("open ") for line in log) - sum(line.startswith("close ") for line in log)


class VirtualBus:
    """A bus in a folder; empty at first."""

    def __init__(self, folder: Path, fps: float = 30.0) -> None:
        self.folder, self.fps = folder, fps
        folder.mkdir(exist_ok=True)
        self._count = 0

    def add_kinect(
        self, serial: str, model: str = "1414", frames: KinectFrames | None = None, plugged: bool = True
    ) -> VirtualKinect:
        """The next Kinect, at port n+1."""
        folder = self.folder / str(self._count)
        self._count += 1
        kinect = VirtualKinect(folder, serial, model, frames or kinect_frames())
        if plugged:
            kinect.plug()
        return kinect


def environment(bus: VirtualBus, base: Mapping[str, str] | None = None) -> dict[str, str]:
    """The environment in which a child process finds this bus in place of the machine's USB."""
    values = dict(os.environ if base is None else base)
    folder = str(library().parent)
    values["LD_LIBRARY_PATH"] = os.pathsep.join(filter(None, [folder, values.get("LD_LIBRARY_PATH")]))
    values.update(_bus_variables(bus))
    return values


def enter(bus: VirtualBus, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make this the bus of every USB context that this process opens from now on."""
    path = library()
    foreign = {
        line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines() if _SONAME in line
    }
    if foreign - {str(path)}:
        raise RuntimeError(f"{foreign} is loaded already: the virtual bus must come first")
    ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
    for name, value in _bus_variables(bus).items():
        monkeypatch.setenv(name, value)


@functools.cache
def library() -> Path:
    """The compiled stand-in for libusb, built once for these sources; skips when it cannot be built."""
    # Found, not loaded: loading libfreenect here would load the real libusb.
    if ctypes.util.find_library("freenect") is None:
        pytest.skip(f"virtual Kinects need libfreenect: {_INSTALL}")
    return compiled("gcc")


def compiled(compiler: str) -> Path:
    """The stand-in as this compiler makes it, for whichever machine; skips when it cannot be built."""
    include = next((path for path in _HEADERS if Path(path, "libusb.h").exists()), None)
    if include is None or shutil.which(compiler) is None:
        pytest.skip(f"virtual Kinects need {compiler} and the libusb header: {_INSTALL}")
    sources = sorted(_SOURCES.glob("*.[ch]"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:16]
    folder = f"kinect-rig-virtual-usb-{os.getuid()}-{compiler}-{digest}"
    built = Path(tempfile.gettempdir()) / folder / _SONAME
    if not built.exists():
        built.parent.mkdir(mode=0o700, exist_ok=True)
        _compile(compiler, [path for path in sources if path.suffix == ".c"], include, built)
    return built


def pack_bits(values: npt.NDArray[np.uint16], bits: int) -> bytes:
    """As the sensor sends them: so many bits a pixel, most significant first, no padding."""
    unpacked = np.unpackbits(values.astype(">u2").view(np.uint8).reshape(-1, 2), axis=1)
    return np.packbits(unpacked[:, 16 - bits :]).tobytes()


def _compile(compiler: str, sources: list[Path], include: str, target: Path) -> None:
    scratch = target.with_suffix(f".{os.getpid()}")  # test workers may compile at the same time
    options = [
        "-O2",
        "-std=gnu11",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-fPIC",
        "-shared",
        f"-Wl,-soname,{_SONAME}",
    ]
    subprocess.run(
        [compiler, *options, f"-I{include}", *map(str, sources), "-o", str(scratch), "-lpthread"], check=True
    )
    scratch.rename(target)


def _bus_variables(bus: VirtualBus) -> dict[str, str]:
    return {"VKINECT_DIR": str(bus.folder), "VKINECT_FPS": str(bus.fps)}


def _mosaic_grbg(color: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    bayer = color[:, :, 1].copy()
    bayer[0::2, 1::2] = color[0::2, 1::2, 2]
    bayer[1::2, 0::2] = color[1::2, 0::2, 0]
    return bayer
