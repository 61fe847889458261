"""Work on batches that the tests of the offline workers send to other processes."""

import hashlib
import os
import signal
import sys
import time
from functools import partial
from pathlib import Path

from rig_calib.offline.capture import open_capture
from rig_calib.offline.workers import Batch, batches_of, open_workers
from rig_protocol.errors import DataError


def digest(batch: Batch) -> str:
    """Of all that the batch's panoramic frames hold."""
    told = hashlib.sha256()
    for one in batch.panoramas():
        told.update(repr((one.index, one.timestamp_ns, sorted(one.frames))).encode())
        for frame in one.frames.values():
            for image in () if frame is None else (frame.raw, frame.bayer, frame.color):
                told.update(b"" if image is None else image.tobytes())
    return told.hexdigest()


def process(batch: Batch) -> int:
    """Who does it."""
    del batch
    return os.getpid()


def digest_killed_once(marker: Path, batch: Batch) -> str:
    """The digest; the first process that comes to position 5 kills itself."""
    if 5 in batch.positions and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return digest(batch)


def always_killed(batch: Batch) -> None:
    """No process survives it."""
    del batch
    os.kill(os.getpid(), signal.SIGKILL)


def refused(batch: Batch) -> int:
    """Position 3 is refused in words."""
    if 3 in batch.positions:
        raise DataError(f"position {batch.positions[0]} is wrong: look at it")
    return batch.positions[0]


def touched(folder: Path, batch: Batch) -> int:
    """Leave a file that says that it was begun."""
    (folder / str(batch.positions[0])).touch()
    return batch.positions[0]


def everybody_works(folder: Path, wanted: int, batch: Batch) -> int:
    """Wait until so many processes are at work at once; this one."""
    del batch
    (folder / str(os.getpid())).touch()
    while len(list(folder.iterdir())) < wanted:
        time.sleep(0.01)
    return os.getpid()


def thread_counts(batch: Batch) -> tuple[int, str | None]:
    """Threads of OpenCV, and what Numba is told."""
    import cv2

    del batch
    return cv2.getNumThreads(), os.environ.get("NUMBA_NUM_THREADS")


def endless(folder: Path, batch: Batch) -> None:
    """Never done; a file says that it was begun, and by whom."""
    del batch
    (folder / str(os.getpid())).touch()
    time.sleep(3600)


def main() -> None:
    """Two processes at work without an end on the take and the folder that the command line names."""
    capture = open_capture(Path(sys.argv[1]))
    with open_workers(2) as workers:
        list(workers.map(partial(endless, Path(sys.argv[2])), batches_of(capture, range(4), 1)))


if __name__ == "__main__":
    main()
