"""What a Pi's agent is installed from: binary wheels for 64-bit Debian 12 (and Raspberry Pi OS), pinned.

pip on this machine chooses them. It weighs the conditions inside other packages' metadata (`; python_version
< "3.12"`) for the Python that it runs on, those of requirements.lock are weighed here for the Pi's.
"""

import json
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path

from packaging.requirements import Requirement

REPOSITORY = Path(__file__).resolve().parents[2]
_PYTHON = "3.11"
_GLIBC_MINORS = range(17, 37)  # Debian 12 has glibc 2.36; 2.17 is the oldest that wheels for aarch64 name
_DEBIAN_12 = {
    "implementation_name": "cpython",
    "platform_machine": "aarch64",
    "platform_python_implementation": "CPython",
    "python_full_version": "3.11.2",
    "python_version": _PYTHON,
    "sys_platform": "linux",
}


def agent_requirements() -> list[str]:
    """What pyproject.toml says that `kinect-rig[agent]` needs."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    return [*project["dependencies"], *project["optional-dependencies"]["agent"]]


def resolve() -> list[str]:
    """File names of what pip would install on a Pi; nothing is kept. AssertionError: no wheels fit."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.json")
        _pip("install", "--dry-run", "--ignore-installed", "--report", report, "--target", folder)
        chosen = json.loads(report.read_text())["install"]
    return [item["download_info"]["url"].rsplit("/", 1)[-1] for item in chosen]


def download(folder: Path) -> None:
    """The wheels of all that the agent needs, and the agent's own, into a folder."""
    _pip("download", "--dest", folder)
    words = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, REPOSITORY]
    subprocess.run(words, check=True)


def index_answers() -> bool:
    """Whether pip gets at a small package of the lock file at all."""
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", folder, "pyusb"]
        return subprocess.run(words, capture_output=True, check=False).returncode == 0


def _pip(command: str, *options: object) -> None:
    """Run a command of pip for the agent's requirements on a Pi."""
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as constraints:
        constraints.write("\n".join(_pins()))
        constraints.flush()
        target: list[str] = ["--python-version", _PYTHON, "--implementation", "cp", "--only-binary=:all:"]
        target += [f"--platform=manylinux_2_{minor}_aarch64" for minor in _GLIBC_MINORS]
        words: Sequence[object] = [sys.executable, "-m", "pip", command, "--quiet", *options, *target]
        words = [*words, "--constraint", constraints.name, *agent_requirements()]
        done = subprocess.run([str(word) for word in words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"pip finds no wheels for a Pi:\n{done.stderr}"


def _pins() -> list[str]:
    """requirements.lock as it reads on a Pi."""
    lines = (REPOSITORY / "requirements.lock").read_text().splitlines()
    pins = [Requirement(line) for line in lines if line and not line.startswith("#")]
    return [f"{pin.name}{pin.specifier}" for pin in pins if not pin.marker or pin.marker.evaluate(_DEBIAN_12)]
