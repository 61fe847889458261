"""Batches of a capture fused, whichever process has them: what comes out is the same."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from threading import Lock

import numba
import numpy as np

from rig_calib.frame_exports.content_hash import content_hash
from rig_calib.frame_exports.job import ExportJob
from rig_calib.fusion.gains import frame_gains
from rig_calib.fusion.live import FusedFrame, LiveFusion, LiveFusionSettings
from rig_calib.offline.capture import Capture
from rig_calib.offline.workers import Batch
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.frames import PanoramicFrame, RgbdFrame

# Idle fusions of this process, all of one content: their tables take a second and some 20 MB a Kinect.
_idle: list[tuple[str, LiveFusion]] = []
_idle_lock = Lock()
_LOOKED_AT = 60  # frames, where cameras join one by one
os.register_at_fork(after_in_child=_idle.clear)  # their threads stay behind in the parent


def fused_batch(
    batch: Batch, calibration: RigCalibration, settings: LiveFusionSettings | None = None
) -> Iterator[tuple[PanoramicFrame, FusedFrame]]:
    """Every panoramic frame of a batch, and what fusion makes of it, which is valid until the next.

    `settings`: by default `usual_settings`. DataError where the file is damaged or nothing can be fused.
    """
    with borrowed_fusion(batch.capture, calibration, settings) as fusion:
        for panorama in batch.panoramas():
            yield panorama, fusion.fuse(panorama)


@contextmanager
def borrowed_fusion(
    capture: Capture, calibration: RigCalibration, settings: LiveFusionSettings | None = None
) -> Iterator[LiveFusion]:
    """A fusion of a capture's cameras, nobody else's meanwhile; the next who asks for the like gets it.

    DataError when nothing can be fused.
    """
    chosen = settings or usual_settings(capture)
    models = {camera.id: camera.model for camera in capture.description.cameras}
    content = {
        "calibration": calibration.to_dict(),
        "models": {camera_id: model.to_dict() for camera_id, model in models.items()},
        "settings": asdict(chosen) | {"gains": {i: np.asarray(g).tolist() for i, g in chosen.gains.items()}},
    }
    key = content_hash(content)
    fusion = _taken(key) or LiveFusion(calibration, models, chosen)
    try:
        yield fusion
    except BaseException:  # who knows what it holds of the frame that went wrong
        fusion.close()
        raise
    _give_back(key, fusion)


def settings_of(job: ExportJob) -> LiveFusionSettings:
    """How the frames of a job are fused; DataError where the file is damaged."""
    settings = replace(usual_settings(job.capture), centre_m=job.look.centre_m)
    if not job.look.match_colors:
        return settings
    chosen = _fullest(job)
    gains = {} if chosen is None else frame_gains(job.capture.description, chosen, job.needed_calibration())
    return replace(settings, gains=gains)


def _fullest(job: ExportJob) -> PanoramicFrame | None:
    """The first panoramic frame of a job's first seconds that no other has more cameras than."""
    placed = job.needed_calibration().poses.keys() & set(job.capture.description.camera_ids)
    fullest, most = None, 0
    for panorama in job.capture.read(job.positions[:_LOOKED_AT]):
        count = sum(_whole(panorama.frames.get(camera_id)) for camera_id in placed)
        if count > most:
            fullest, most = panorama, count
        if most == len(placed):
            break
    return fullest


def _whole(frame: RgbdFrame | None) -> bool:
    return frame is not None and not frame.damaged


def usual_settings(capture: Capture) -> LiveFusionSettings:
    """The defaults, with depth images in the camera that the capture's first ones are in.

    One thread where this process is one of several workers (dask_workers.py).
    """
    threads = min(2, numba.get_num_threads())
    for panorama in capture.read(range(len(capture.marks))):
        for frame in panorama.frames.values():
            if frame is not None and (frame.raw is not None or frame.depth_mm is not None):
                return LiveFusionSettings(depth_frame=frame.depth_frame, threads=threads)
    return LiveFusionSettings(threads=threads)


def _taken(key: str) -> LiveFusion | None:
    with _idle_lock:
        for place, (held, fusion) in enumerate(_idle):
            if held == key:
                del _idle[place]
                return fusion
    return None


def _give_back(key: str, fusion: LiveFusion) -> None:
    with _idle_lock:
        stale = [other for held, other in _idle if held != key]
        _idle[:] = [(held, other) for held, other in _idle if held == key]
        _idle.append((key, fusion))
    for other in stale:
        other.close()
