"""Network namespaces of this process: made, entered, run in, and removed whatever happened.

A process that was killed leaves its namespaces behind; the next one to make some removes them. All this
needs root and iproute2.
"""

import ctypes
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import IO

_PREFIX = "kinect-rig"
_OWNER = re.compile(rf"{_PREFIX}-(\d+)-")
_FOLDER = Path("/run/netns")  # where `ip netns` keeps them
_CLONE_NEWNET = 0x40000000  # <linux/sched.h>
_TOOLS = ("ip", "tc", "nft", "ethtool")
_DROP_SOME = """table bridge probe {
  chain forward { type filter hook forward priority 0; numgen random mod 100 < 1 drop; }
}
"""
_STOP_TIMEOUT_S = 5.0

_groups = itertools.count()
_libc = ctypes.CDLL(None, use_errno=True)


class Namespaces:
    """Namespaces that a `with` block owns, each under a short name; processes in them end with the block."""

    def __init__(self) -> None:
        self._prefix = f"{_PREFIX}-{os.getpid()}-{next(_groups)}-"
        self._names: list[str] = []
        self._processes: list[subprocess.Popen[str]] = []

    def add(self, place: str) -> None:
        """Make one, with its loopback up."""
        self._names.append(place)
        command(f"ip netns add {self.full_name(place)}")
        self.command(place, "ip link set lo up")

    def full_name(self, place: str) -> str:
        """The name by which `ip netns` knows it."""
        return self._prefix + place

    def prefix(self, place: str) -> list[str]:
        """Words before a command that run it there, in the process that is started."""
        return ["ip", "netns", "exec", self.full_name(place)]

    def command(self, place: str, line: str, script: str | None = None) -> str:
        """Run a command there to its end; what it printed."""
        return command(f"ip netns exec {self.full_name(place)} {line}", script)

    def start(
        self,
        place: str,
        argv: Sequence[str],
        env: Mapping[str, str] | None = None,
        stdout: int | IO[str] | None = None,
    ) -> subprocess.Popen[str]:
        """Start a process there; it is ended with the namespaces at the latest."""
        words = [*self.prefix(place), *argv]
        process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=stdout, env=env, text=True)
        self._processes.append(process)
        return process

    @contextmanager
    def inside(self, place: str) -> Iterator[None]:
        """The calling thread is there: sockets that it opens meanwhile stay there."""
        with Path("/proc/thread-self/ns/net").open() as home:
            with (_FOLDER / self.full_name(place)).open() as there:
                _enter(there.fileno())
            try:
                yield
            finally:
                _enter(home.fileno())

    def remove(self) -> None:
        """End every process in them and remove them; harmless when removed."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            try:
                process.wait(_STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdout is not None:
                process.stdout.close()
        self._processes.clear()
        while self._names:
            _remove(self.full_name(self._names.pop()))


def command(line: str, script: str | None = None) -> str:
    """Run a command to its end, with `script` as its input; OSError with what it said when it fails."""
    done = subprocess.run(line.split(), input=script, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise OSError(f"{line}: {done.stderr.strip() or done.stdout.strip()}")
    return done.stdout


def existing_namespaces() -> list[str]:
    """Names of all network namespaces of this machine."""
    listed = command("ip -j netns list")
    return [entry["name"] for entry in json.loads(listed or "[]")]


def remove_stale() -> None:
    """Remove namespaces whose owner has died without doing it."""
    for name in existing_namespaces():
        owner = _OWNER.match(name)
        if owner is not None and not _alive(int(owner[1])):
            _remove(name)


@cache
def why_unavailable() -> str | None:
    """One sentence on why this machine cannot emulate a network, or None when it can; it is tried out."""
    if os.geteuid() != 0:
        return "an emulated network needs root"
    missing = [tool for tool in _TOOLS if shutil.which(tool) is None]
    if missing:
        return f"an emulated network needs {', '.join(missing)}: apt install iproute2 nftables ethtool"
    probe = Namespaces()
    try:
        remove_stale()
        probe.add("probe")
        probe.command("probe", "ip link add bridge type bridge")
        probe.command("probe", "ip link add left type veth peer name right")
        probe.command("probe", "tc qdisc add dev left root tbf rate 1gbit burst 16kb limit 128kb")
        probe.command("probe", "nft -f -", _DROP_SOME)
    except OSError as error:
        return f"this kernel or container does not let a network be emulated: {error}"
    finally:
        probe.remove()
    return None


def _alive(process_id: int) -> bool:
    return Path(f"/proc/{process_id}").exists()


def _remove(name: str) -> None:
    """What still runs there was started by its owner, for instance by a program under test."""
    try:
        for process_id in command(f"ip netns pids {name}").split():
            with suppress(ProcessLookupError):
                os.kill(int(process_id), signal.SIGKILL)
        command(f"ip netns delete {name}")
    except OSError:
        if name in existing_namespaces():  # else another process has removed it meanwhile
            raise


def _enter(descriptor: int) -> None:
    if _libc.setns(descriptor, _CLONE_NEWNET) != 0:
        raise OSError(ctypes.get_errno(), f"setns: {os.strerror(ctypes.get_errno())}")
