"""Exports of a file, or a few, a panoramic frame: which frames there are, and where each one goes."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rig_calib.frame_exports.fused_batches import borrowed_fusion, settings_of
from rig_calib.frame_exports.job import Exported, ExportJob
from rig_calib.frame_exports.placed_cameras import placed_cameras, unplaced_notes
from rig_calib.frame_exports.time_stamps import TimeStamps
from rig_calib.fusion.live import FusedFrame, LiveFusion, LiveFusionSettings
from rig_calib.offline.workers import Batch, batches_of
from rig_calib.rig_calibration import RigCalibration
from rig_calib.whole_folder import refuse_existing, whole_folder
from rig_protocol.errors import ConfigurationError

BATCH_FRAMES = 4


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A fused panoramic frame, and what tells where and when it is.

    `utc_ns`: Unix time of its exposures, to a second; None where the capture does not tell.
    """

    fused: FusedFrame
    fusion: LiveFusion
    calibration: RigCalibration
    utc_ns: int | None = None


WriteScene = Callable[[Path, Scene], None]
"""Writes the file there, whole or not at all; importable by other processes."""


@dataclass(frozen=True, slots=True, eq=False)
class _Writer:
    """What a worker does with a batch."""

    write: WriteScene
    path_of: Callable[[int], Path]
    calibration: RigCalibration
    settings: LiveFusionSettings
    utc_minus_rig_ns: int | None

    def __call__(self, batch: Batch) -> tuple[int, Counter[str]]:
        """Write its files; how many frames that were, and what was left out of how many."""
        written, skipped = 0, Counter[str]()
        with borrowed_fusion(batch.capture, self.calibration, self.settings) as fusion:
            for panorama in batch.panoramas():
                fused = fusion.fuse(panorama)
                scene = Scene(fused, fusion, self.calibration, self._utc_ns(fused.timestamp_ns))
                self.write(self.path_of(panorama.index), scene)
                skipped.update(fused.skipped)
                written += 1
        return written, skipped

    def _utc_ns(self, rig_time_ns: int) -> int | None:
        ahead_ns = self.utc_minus_rig_ns
        return None if ahead_ns is None else rig_time_ns + ahead_ns


def export_scenes(job: ExportJob, name: str, suffix: str, write: WriteScene) -> Exported:
    """`name`_000123`suffix` of every panoramic frame in the folder `out`, or `out` itself of the only one.

    ConfigurationError where `out` exists.
    """
    if job.out.suffix == suffix and len(job.positions) == 1:
        refuse_existing(job.out)
        make_folder_of(job.out)
        return Exported((job.out,), _write_scenes(job, write, partial(_alone, job.out.absolute())))
    with whole_folder(job.out) as folder:
        notes = _write_scenes(job, write, partial(_numbered, folder.absolute(), name, suffix))
    return Exported((job.out,), notes)


def make_folder_of(path: Path) -> None:
    """Make the folder that a file comes into; ConfigurationError where that is not possible."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"cannot write to {path.parent}: {error.strerror}") from error


def notes_of(job: ExportJob, skipped: Counter[str]) -> tuple[str, ...]:
    """What was left out, once each, and of how many of the frames."""
    frames = len(job.positions)
    some = (
        why if count == frames else f"{why} ({count} of {frames} panoramic frames)"
        for why, count in skipped.items()
    )
    return (*unplaced_notes(job, placed_cameras(job)), *some)


def _write_scenes(job: ExportJob, write: WriteScene, path_of: Callable[[int], Path]) -> tuple[str, ...]:
    calibration, settings = job.needed_calibration(), settings_of(job)
    writer = _Writer(write, path_of, calibration, settings, TimeStamps.of(job.capture).utc_minus_rig_ns)
    written, skipped = 0, Counter[str]()
    for count, own in job.workers.map(writer, batches_of(job.capture, job.positions, BATCH_FRAMES), job.tell):
        written += count
        skipped.update(own)
    job.refuse_nothing(written)
    return notes_of(job, skipped)


def _numbered(folder: Path, name: str, suffix: str, index: int) -> Path:
    return folder / f"{name}_{index:06d}{suffix}"


def _alone(path: Path, _index: int) -> Path:
    return path
