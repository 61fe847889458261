"""Debian machines made by debootstrap: a root folder that is entered by chroot, then booted in namespaces.

Mirrors, proxies and certificates are those that this machine's own apt and pip are set up with.
"""

import ast
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

NEEDS = ("debootstrap", "systemd-nspawn", "nsenter", "ip")
SUITE = "bookworm"
_PACKAGES = "systemd,systemd-sysv,dbus,python3,iproute2"  # what any Debian image has
_PIP_OPTIONS = ("index-url", "extra-index-url", "cert", "proxy", "trusted-host", "timeout")
_BOOT_TIMEOUT_S = 60.0
_ENTER = '#!/bin/sh\nroot=$1; shift\nexec nsenter --target "$(cat "$root.leader")" --all --wd=/ "$@"\n'


def make_base(root: Path) -> None:
    """A minimal Debian at `root`, unless it is there already; it takes some minutes."""
    done = root.with_suffix(".done")
    if done.exists():
        return
    shutil.rmtree(root, ignore_errors=True)
    _run(["debootstrap", "--variant=minbase", f"--include={_PACKAGES}", SUITE, str(root), *mirror()])
    acquire = _run(["apt-config", "dump", "Acquire"])
    (root / "etc/apt/apt.conf.d/90host").write_text(acquire)
    _copy_pip_settings(root)
    done.touch()


class DebianMachine:
    """One machine: not running at first."""

    def __init__(self, base: Path, root: Path) -> None:
        """A fresh copy of the base."""
        self.root, self.name = root, root.name
        self._leader_file = root.with_name(f"{root.name}.leader")
        self._nspawn: subprocess.Popen[bytes] | None = None
        shutil.rmtree(root, ignore_errors=True)
        _run(["cp", "--archive", str(base), str(root)])
        (root / "etc/hostname").write_text(f"{self.name}\n")

    def run(self, *argv: str, check: bool = True) -> str:
        """Run a command in it, booted or not; what it printed to both."""
        if self._nspawn is None:
            words = ["chroot", str(self.root), *argv]
        else:
            words = ["nsenter", "--target", self._leader_file.read_text(), "--all", "--wd=/", *argv]
        return _run(words, check=check)

    def boot(self, network_namespace: str) -> None:
        """Start its systemd as the first process of namespaces of its own; returns when it is up."""
        words = ["setpriv", "--pdeathsig", "KILL"]  # it ends with us, whatever ends us
        words += ["systemd-nspawn", "--quiet", "--register=no", "--keep-unit", "--boot", "--console=pipe"]
        words += [f"--directory={self.root}", f"--machine={self.name}", "--resolv-conf=off"]
        words += [f"--network-namespace-path=/run/netns/{network_namespace}"]
        self._nspawn = subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        until_s = time.monotonic() + _BOOT_TIMEOUT_S
        while not self._is_up():
            assert self._nspawn.poll() is None, f"{self.name} does not boot"
            assert time.monotonic() < until_s, f"{self.name} does not come up"
            time.sleep(0.2)

    def power_off(self) -> None:
        """End it at once; harmless when it is not running."""
        if self._nspawn is not None:
            leader = self._leader_file.read_text() if self._leader_file.exists() else ""
            if leader:
                subprocess.run(["kill", "-KILL", leader], check=False)
            self._nspawn.terminate()
            self._nspawn.wait()
            self._nspawn = None

    def connection(self, enter: Path | None) -> str:
        """Variables of Ansible that lead here: by chroot, or by `enter` (written by `write_enter`)."""
        words = f"ansible_connection=community.general.chroot ansible_host={self.root}"
        return words if enter is None else f"{words} ansible_chroot_exe={enter}"

    def _is_up(self) -> bool:
        assert self._nspawn is not None
        children = Path(f"/proc/{self._nspawn.pid}/task/{self._nspawn.pid}/children").read_text().split()
        if not children or Path(f"/proc/{children[0]}/comm").read_text() != "systemd\n":
            return False
        self._leader_file.write_text(children[0])
        return self.run("systemctl", "is-system-running", check=False).strip() in ("running", "degraded")


def write_enter(path: Path) -> Path:
    """A stand-in for chroot that enters a booted machine."""
    path.write_text(_ENTER)
    path.chmod(0o755)
    return path


def mirror() -> list[str]:
    """Where this machine's apt finds the suite; nothing: debootstrap's own default."""
    listed = _run(["apt-get", "indextargets", "--format", "$(CREATED_BY) $(RELEASE) $(SITE)"])
    sites = [line.split() for line in listed.splitlines()]
    return next(([site] for kind, suite, site in sites if (kind, suite) == ("Packages", SUITE)), [])


def _copy_pip_settings(root: Path) -> None:
    listed = _run([sys.executable, "-m", "pip", "config", "list"])
    pairs = [line.partition("=") for line in listed.splitlines()]
    # What the environment says comes last and wins.
    settings = {key.rpartition(".")[2]: str(ast.literal_eval(value)) for key, _, value in sorted(pairs)[::-1]}
    kept = {key: " ".join(settings[key].split()) for key in _PIP_OPTIONS if key in settings}
    (root / "etc/pip.conf").write_text("".join(["[global]\n", *(f"{k} = {v}\n" for k, v in kept.items())]))
    if "cert" in kept:
        # The second copy is for the package ca-certificates, which makes the system's bundle anew.
        for place in (kept["cert"].lstrip("/"), "usr/local/share/ca-certificates/test-machine.crt"):
            (root / place).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(kept["cert"], root / place)


def _run(words: Sequence[str], *, check: bool = True) -> str:
    done = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    assert not check or done.returncode == 0, f"{' '.join(words)}: status {done.returncode}\n{done.stdout}"
    return done.stdout
