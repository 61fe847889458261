"""Whether the workers of a cluster can do the work: the same release, the same files at the same path."""

from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rig_calib.offline.capture import Capture
from rig_calib.recorded_panoramas import is_recording
from rig_protocol.errors import ConfigurationError
from rig_protocol.recording import part_paths

_PACKAGE = "kinect-rig"
WAIT_S = 10.0

Seen = tuple[str | None, Mapping[str, int | None]]
"""Release of our package, and sizes of files; None of what is not there."""


def check_workers(client: Any, address: str, captures: Iterable[Capture]) -> None:
    """Ask every worker; ConfigurationError says which ones lack what, or that there are none."""
    try:
        client.wait_for_workers(1, timeout=WAIT_S)
    except TimeoutError:
        raise ConfigurationError(
            f"the Dask scheduler at {address} has no workers: start some with "
            f"`dask worker {address} --nworkers -1 --nthreads 1`"
        ) from None
    files = [str(path) for capture in captures for path in _files_of(capture.path)]
    look = _look_of(_PACKAGE)
    own = look(files)
    found = {worker: lack(seen, own) for worker, seen in client.run(look, files).items()}
    lacking = [f"worker {worker} {what}" for worker, what in sorted(found.items()) if what is not None]
    if lacking:
        raise ConfigurationError("; ".join(lacking))


def _files_of(capture: Path) -> list[Path]:
    return part_paths(capture) if is_recording(capture) else [capture / "nominal.json"]


def _look_of(package: str) -> Callable[[list[str]], Seen]:
    """A function that stands alone: it works where our package is not installed."""

    def look(files: list[str]) -> Seen:
        from importlib.metadata import PackageNotFoundError, version
        from pathlib import Path

        try:
            release = version(package)
        except PackageNotFoundError:
            release = None
        sizes = {file: Path(file).stat().st_size if Path(file).exists() else None for file in files}
        return release, sizes

    return look


def lack(seen: Seen, own: Seen) -> str | None:
    """What a worker that has seen this lacks of what we have, in words."""
    if seen[0] is None:
        return f"has no {_PACKAGE}: install {version(_PACKAGE)} there"
    if seen[0] != own[0]:
        return f"has release {seen[0]} of {_PACKAGE}, this is {own[0]}: install the same"
    for file, size in own[1].items():
        if seen[1][file] is None:
            return f"does not see {file}: put the capture on a share that all mount at this path"
        if seen[1][file] != size:
            return f"sees another {file}: put the capture on a share that all mount at this path"
    return None
