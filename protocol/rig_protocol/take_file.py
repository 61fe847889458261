"""The files of a take that is being recorded: split by size, with room kept to end each in order."""

import contextlib
import errno
import fcntl
import tempfile
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from rig_protocol.errors import ConfigurationError
from rig_protocol.recording import RecordingWriter, part_path
from rig_protocol.recording_format import Entry

# Holds the chunk in progress (6 MiB at most), what is to be written behind it, and the indexes of 30 GiB.
_RESERVE_BYTES = 16 << 20
_FULL = (errno.ENOSPC, errno.EDQUOT)


class DiskFile:
    """A new file that can still be ended in order when its disk is full: `full` says that it is time to.

    Keeps some room in a file without a name, which vanishes with the process. ConfigurationError where there
    is no such room, or the file exists and holds something.
    """

    def __init__(self, path: Path) -> None:
        self.full = False
        self._size = 0
        self._reserve: IO[bytes] | None = None
        if path.exists() and path.stat().st_size:
            raise ConfigurationError(f"{path} exists: a recording overwrites nothing, give another name")
        try:
            self._file = path.open("wb", buffering=0)
            with contextlib.suppress(OSError):  # some network disks have no locks
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # for `recover`; ends with the process
            self._reserve = tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115  # open as long as this object
            self._reserve.write(bytes(_RESERVE_BYTES))
            self._reserve.flush()
        except OSError as error:
            self._let_go()
            raise ConfigurationError(f"{path} cannot be recorded to: {error.strerror}") from error

    def write(self, data: bytes, /) -> int:
        """Write all of it, if need be in the room kept; OSError when the disk fails."""
        rest = memoryview(data)
        while rest:
            try:
                rest = rest[self._file.write(rest) or 0 :]
            except OSError as error:
                if error.errno not in _FULL or self._reserve is None:
                    raise
                self.full = True
                self._let_go()
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """How much was written."""
        return self._size

    def flush(self) -> None:
        """Nothing is buffered here."""

    def close(self) -> None:
        """End; harmless when already closed."""
        self._let_go()
        self._file.close()

    def _let_go(self) -> None:
        if self._reserve is not None:
            self._reserve.close()
            self._reserve = None


class TakeFile:
    """A take in parts of about `part_bytes`; one thread at a time. OSError when the disk fails.

    `now_ns` reads the clock of its times, `clock` is that clock's name. `moment` tells UTC together with a
    clock that is not this machine's.
    """

    def __init__(
        self,
        path: Path,
        part_bytes: float,
        now_ns: Callable[[], int],
        clock: str | None = None,
        moment: Callable[[], tuple[str, int]] | None = None,
    ) -> None:
        _refuse_strange_parts(path)
        self._path, self._part_bytes = path, part_bytes
        self._now_ns, self._clock, self._moment = now_ns, clock, moment or self._now
        self._number, self._before = 0, 0
        self._documents: Mapping[str, Any] = {}
        self._attached: dict[str, Any] = {}
        self._open()

    @property
    def size(self) -> int:
        """Bytes written, all parts."""
        return self._before + self._disk.tell()

    @property
    def full(self) -> bool:
        """True when the disk is full: write no more, and finish."""
        return self._disk.full

    def write(self, entry: Entry) -> None:
        """Add an entry; where the part is large enough, in the next one."""
        if self._writer.size >= self._part_bytes:
            self._finish_part({})
            self._before += self._disk.tell()
            self._number += 1
            self._open()
        self._writer.write(entry)

    def flush(self, documents: Mapping[str, Any]) -> None:
        """Attach what is new in the documents, and hand everything to the operating system."""
        self._documents = documents
        self._attach()
        self._writer.flush()

    def finish(self, cameras: Mapping[str, Mapping[str, int]]) -> None:
        """End the last part in order."""
        try:
            self._finish_part(cameras)
        finally:
            self._disk.close()

    def close(self) -> None:
        """Let go of the disk, as after an error; what was written stays. Harmless when already ended."""
        self._disk.close()

    def _open(self) -> None:
        self._disk = DiskFile(part_path(self._path, self._number))
        created, now_ns = self._moment()
        self._writer = RecordingWriter(self._disk, created, now_ns, self._clock)
        self._attached.clear()
        self._attach()

    def _now(self) -> tuple[str, int]:
        return datetime.now(UTC).isoformat(timespec="seconds"), self._now_ns()

    def _attach(self) -> None:
        for name, values in self._documents.items():
            if self._attached.get(name) is not values:  # writing a calibration as JSON takes some ms
                self._writer.attach(name, values, self._now_ns())
                self._attached[name] = values

    def _finish_part(self, cameras: Mapping[str, Mapping[str, int]]) -> None:
        self._writer.finish(cameras, self._now_ns())
        self._disk.close()


def _refuse_strange_parts(path: Path) -> None:
    """ConfigurationError where readers would take this and another take for parts of one."""
    after = part_path(path, 1)
    if after.exists():
        raise ConfigurationError(f"{after} exists, and would be read as a part of {path}: give another name")
    name, _, number = path.stem.rpartition(".")
    first = path.with_name(name + path.suffix)
    if len(number) >= 3 and number.isdecimal() and first.exists():
        raise ConfigurationError(f"{path} would be read as a part of {first}: give another name")
