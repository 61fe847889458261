"""The machine that the doctor looks at: its files below one root, and what kernel and libraries answer.

Tests put a folder of files in place of the root and functions in place of the questions.
"""

import ctypes
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rig_agent.config import AgentSettings
from rig_agent.sources import open_source
from rig_agent.sources.base import FrameSource
from rig_agent.sources.libfreenect import load_libfreenect
from rig_agent.usb import enumerate as usb_bus
from rig_protocol.system_clock import KernelClock, kernel_clock

_COMMAND_LIMIT_S = 3.0
_MOST_BYTES = 1 << 20  # of a file: the longest read here, /proc/self/maps, has some hundred KiB


def command_output(words: Sequence[str]) -> str | None:
    """What a program printed; None when it is absent, fails or takes too long."""
    try:
        done = subprocess.run(  # noqa: S603  # our own fixed words
            words, capture_output=True, text=True, timeout=_COMMAND_LIMIT_S, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def may_open(node: Path) -> bool:
    """True when this user may read and write a device node."""
    return os.access(node, os.R_OK | os.W_OK)


def free_bytes(folder: Path) -> int:
    """What is free to us on the file system of a folder."""
    return shutil.disk_usage(folder).free


@dataclass(frozen=True, slots=True)
class Machine:
    """Where the doctor gets everything from."""

    root: Path = Path("/")
    command_output: Callable[[Sequence[str]], str | None] = command_output
    may_open: Callable[[Path], bool] = may_open
    free_bytes: Callable[[Path], int] = free_bytes
    usb_devices: Callable[[], list[usb_bus.UsbDevice]] = usb_bus.usb_devices
    check_access: Callable[[usb_bus.KinectCamera], None] = usb_bus.check_access
    load_library: Callable[[str], ctypes.CDLL] = ctypes.CDLL
    load_libfreenect: Callable[[Path | None], ctypes.CDLL] = load_libfreenect
    open_source: Callable[[AgentSettings], FrameSource] = open_source
    kernel_clock: Callable[[], KernelClock] = kernel_clock

    def path(self, path: str) -> Path:
        """An absolute path, below the root."""
        return self.root / path.lstrip("/")

    def text(self, path: str) -> str | None:
        """What a file holds; None when it is absent or does not tell."""
        try:
            with self.path(path).open("rb") as file:
                return file.read(_MOST_BYTES).decode(errors="replace").strip("\0\n ")
        except OSError:
            return None

    def number(self, path: str) -> int | None:
        """The whole number that a file holds."""
        text = self.text(path)
        try:
            return None if text is None else int(text)
        except ValueError:
            return None

    def files(self, folders: Sequence[str], pattern: str) -> Iterator[str]:
        """What each matching file of some folders holds."""
        for folder in folders:
            for found in sorted(self.path(folder).glob(pattern)):
                yield self.text(str(found.relative_to(self.root))) or ""

    def runs(self, program: str) -> bool:
        """True when another process, whoever's, was started as `program`."""
        for process in self.path("/proc").glob("[0-9]*"):
            words = (self.text(f"/proc/{process.name}/cmdline") or "").split("\0")
            if "--check" in words:  # another doctor, or the sudo that started this one
                continue
            if any(Path(word).name == program for word in words[:2]):
                return True
        return False
