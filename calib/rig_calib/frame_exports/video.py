"""The panorama as a video: H.264 in MP4 for people, lossless FFV1 in Matroska for programs."""

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from typing import Any, BinaryIO, Literal

import av
import numpy as np
from av.container import OutputContainer
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc, Interpolation
from av.video.stream import VideoStream

from rig_calib.frame_exports.frame_files import BATCH_FRAMES, make_folder_of, notes_of
from rig_calib.frame_exports.fused_batches import borrowed_fusion, settings_of
from rig_calib.frame_exports.job import Exported, ExportJob
from rig_calib.frame_exports.panorama_geometry import panorama_geometry
from rig_calib.fusion.live import LiveFusionSettings
from rig_calib.offline.workers import Batch, batches_of
from rig_calib.recorded_panoramas import is_recording
from rig_calib.rig_calibration import RigCalibration
from rig_calib.whole_file import whole_file
from rig_calib.whole_folder import refuse_existing
from rig_protocol.errors import ConfigurationError
from rig_protocol.frames import ImageU8

_TICKS = 90_000  # a second, as in MPEG
_YUV = "yuv420p"
# By default FFmpeg rounds down, which darkens every colour by one to three.
_ROUNDED = Interpolation.AREA | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INP


@dataclass(frozen=True, slots=True)
class _Codec:
    """What FFmpeg calls container, codec and its pixels; `options` of the encoder."""

    container: str
    name: Literal["libx264", "ffv1"]
    pixels: str
    options: Mapping[str, str]


_CODECS = {
    ".mp4": _Codec("mp4", "libx264", _YUV, {"crf": "18"}),
    ".mkv": _Codec("matroska", "ffv1", "bgr0", {"level": "3", "slicecrc": "1"}),
}


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    """What a worker makes of a batch: panoramas (H,W,3), BGR, when they were taken, and what was left out."""

    images: list[ImageU8]
    timestamps_ns: list[int]
    skipped: Counter[str]
    geometry: dict[str, Any]


def export(job: ExportJob) -> Exported:
    """One file; frames keep the times of a recording, those of a rig folder come at `fps`.

    ConfigurationError where `out` exists or ends with neither .mp4 nor .mkv.
    """
    codec = _CODECS.get(job.out.suffix)
    if codec is None:
        raise ConfigurationError(f"{job.out} must end with .mp4 (H.264) or .mkv (lossless FFV1)")
    refuse_existing(job.out)
    draw = partial(_draw, calibration=job.needed_calibration(), settings=settings_of(job))
    make_folder_of(job.out)
    drawn = job.workers.map(draw, batches_of(job.capture, job.positions, BATCH_FRAMES), job.tell)
    with whole_file(job.out) as file:
        skipped = _encode(file, codec, job, drawn)
    return Exported((job.out,), notes_of(job, skipped))


def _draw(batch: Batch, calibration: RigCalibration, settings: LiveFusionSettings) -> _Drawn:
    with borrowed_fusion(batch.capture, calibration, settings) as fusion:
        drawn = _Drawn([], [], Counter(), panorama_geometry(fusion, calibration))
        for panorama in batch.panoramas():
            fused = fusion.fuse(panorama)
            drawn.images.append(fused.panorama.copy())
            drawn.timestamps_ns.append(fused.timestamp_ns)
            drawn.skipped.update(fused.skipped)
    return drawn


def _encode(file: BinaryIO, codec: _Codec, job: ExportJob, drawn: Iterator[_Drawn]) -> Counter[str]:
    """Encode the batches in their order; what was left out of them."""
    skipped: Counter[str] = Counter()
    clock = _Clock(None if is_recording(job.capture.path) else job.fps)
    with av.open(file, "w", format=codec.container) as container:
        stream: VideoStream | None = None
        for batch in drawn:
            if not batch.images:
                continue
            stream = stream or _stream(container, codec, job, batch)
            for image, timestamp_ns in zip(batch.images, batch.timestamps_ns, strict=True):
                frame = _frame(image, codec)
                frame.pts, frame.time_base = clock.ticks(timestamp_ns), Fraction(1, _TICKS)
                container.mux(stream.encode(frame))
            skipped.update(batch.skipped)
        if stream is not None:
            container.mux(stream.encode(None))
    job.refuse_nothing(clock.count)
    return skipped


def _stream(container: OutputContainer, codec: _Codec, job: ExportJob, batch: _Drawn) -> VideoStream:
    container.metadata["title"] = f"Panorama of {job.capture.path.name}"
    container.metadata["comment"] = json.dumps(batch.geometry)
    stream = container.add_stream(
        codec.name, rate=Fraction(job.fps).limit_denominator(1001), options=dict(codec.options)
    )
    height, width = _fitting(batch.images[0], codec).shape[:2]
    stream.width, stream.height, stream.pix_fmt = width, height, codec.pixels
    context = stream.codec_context
    context.time_base = Fraction(1, _TICKS)
    if codec.pixels == _YUV:
        context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
        context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
    return stream


def _frame(image: ImageU8, codec: _Codec) -> av.VideoFrame:
    frame = av.VideoFrame.from_ndarray(_fitting(image, codec), format="bgr24")
    if codec.pixels != _YUV:
        return frame.reformat(format=codec.pixels)
    return frame.reformat(
        format=_YUV,
        dst_colorspace=Colorspace.ITU709,
        dst_color_range=ColorRange.MPEG,
        interpolation=int(_ROUNDED),
    )


def _fitting(image: ImageU8, codec: _Codec) -> ImageU8:
    """The image, for 4:2:0 with a black row and column more where it has an odd number of them."""
    if codec.pixels != _YUV:
        return image
    height, width = image.shape[:2]
    return np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)))


class _Clock:
    """Ticks since the first frame, ever greater: of the frames' own times, or of a rate `fps`."""

    def __init__(self, fps: float | None) -> None:
        self._fps = fps
        self.count = 0
        self._begin_ns, self._last = 0, -1

    def ticks(self, timestamp_ns: int) -> int:
        """Those of the next frame."""
        if self.count == 0:
            self._begin_ns = timestamp_ns
        seconds = (timestamp_ns - self._begin_ns) * 1e-9 if self._fps is None else self.count / self._fps
        self._last = max(self._last + 1, round(seconds * _TICKS))
        self.count += 1
        return self._last
