"""An arm64 Debian root that runs on another processor: debootstrap's first stage under qemu's user emulation.

Packages are unpacked, not configured: no program in the root needs more, and nothing has to be registered
with this machine's kernel. The root has no other processes than those that are started in it.
"""

import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from support.debian_machine import SUITE, mirror
from support.pi_wheels import download

COMPILER = "aarch64-linux-gnu-gcc"
_EMULATOR = "qemu-aarch64-static"
_PACKAGES = "python3,python3-venv,libfreenect0.5"
_WHEELS, _VENV = "srv/wheels", "opt/kinect-rig"
_IN_ROOT = 'mount --rbind /proc "$0/proc" && mount --rbind /dev "$0/dev" && exec chroot "$0" "$@"'


def missing() -> str | None:
    """What this machine lacks for it, in words; None: nothing."""
    if os.geteuid() != 0:
        return "an arm64 root is made and entered by root only"
    absent = [tool for tool in ("debootstrap", _EMULATOR, COMPILER) if shutil.which(tool) is None]
    if absent:
        return f"{', '.join(absent)} absent: apt install debootstrap qemu-user-static gcc-aarch64-linux-gnu"
    return None


class Arm64Root:
    """The root of one Pi."""

    def __init__(self, path: Path) -> None:
        """Made by debootstrap unless it is there; AssertionError where that fails."""
        self.path = path
        done = path.with_suffix(".done")
        if done.exists():
            return
        shutil.rmtree(path, ignore_errors=True)
        words = ["debootstrap", "--foreign", "--arch=arm64", "--variant=minbase", f"--include={_PACKAGES}"]
        _run([*words, SUITE, str(path), *mirror()])
        for package in sorted((path / "var/cache/apt/archives").glob("*.deb")):
            _unpack(package, path)
        (path / "proc").unlink()  # debootstrap may leave a link
        (path / "proc").mkdir()
        shutil.copy2(str(shutil.which(_EMULATOR)), path / "usr/bin")
        done.touch()

    def enter(self) -> list[str]:
        """Words before a command that run it in the root, with the machine's network, mounts of its own."""
        return ["unshare", "--mount", "sh", "-c", _IN_ROOT, str(self.path), f"/usr/bin/{_EMULATOR}"]

    def run(self, *argv: str, environment: Mapping[str, str] | None = None) -> str:
        """Run a command of the root, by its full path, to its end; what it printed."""
        return _run([*self.enter(), *argv], {"PATH": os.environ["PATH"], **(environment or {})})

    def install_agent(self) -> tuple[str, str]:
        """`kinect-rig[agent]` from wheels alone, by the root's own pip; the words that start rig-agent."""
        for folder in (_WHEELS, _VENV):
            shutil.rmtree(self.path / folder, ignore_errors=True)
        (self.path / _WHEELS).mkdir(parents=True)
        download(self.path / _WHEELS)
        self.run("/usr/bin/python3", "-m", "venv", "--without-pip", f"/{_VENV}")
        pip = next((self.path / "usr/share/python-wheels").glob("pip-*.whl")).name
        words = ["-m", "pip", "install", "--quiet", "--no-index", f"--find-links=/{_WHEELS}"]
        environment = {"PYTHONPATH": f"/usr/share/python-wheels/{pip}"}
        self.run(f"/{_VENV}/bin/python", *words, "kinect-rig[agent]", environment=environment)
        return f"/{_VENV}/bin/python", f"/{_VENV}/bin/rig-agent"


def _unpack(package: Path, root: Path) -> None:
    contents = subprocess.run(["dpkg-deb", "--fsys-tarfile", package], capture_output=True, check=True).stdout
    # /lib is a link to /usr/lib and stays one.
    subprocess.run(["tar", "-x", "--keep-directory-symlink", "-C", root], input=contents, check=True)


def _run(words: Sequence[str], environment: Mapping[str, str] | None = None) -> str:
    done = subprocess.run(
        words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    assert done.returncode == 0, f"{' '.join(words)}: status {done.returncode}\n{done.stdout}"
    return done.stdout
