"""The fusing sink: fuses the latest set, on a thread of its own, with the calibration that is in force."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from rig_calib.fusion.gains import frame_gains
from rig_calib.fusion.live import FusedFrame, LiveFusion, LiveFusionSettings
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.camera import CameraModel
from rig_protocol.errors import DataError
from rig_protocol.frames import DepthFrame, PanoramicFrame
from rig_protocol.rig_folder import RigDescription
from rig_server.latest_only import LatestOnly

_NICENESS = 5  # receiving and decoding come first
_FULLEST_AGE_S = 1.0
_MODELS_AGE_S = 2.0  # reading the models may mean reading files


@dataclass(frozen=True, slots=True)
class FusionReport:
    """How fusing goes: sets fused and passed over since the start, what the last one took, and what is wrong.

    `trouble` is None while all is well, else a sentence. `skipped`: which cameras gave nothing, and why.
    """

    fused: int = 0
    passed_over: int = 0
    seconds: float | None = None
    skipped: tuple[str, ...] = ()
    trouble: str | None = None


class FuseSink:
    """Fuses from `start` to `stop`. Offering never waits: a set that finds it busy gives way to a newer one.

    Every FusedFrame goes to `listener`, on the sink's thread; its arrays hold until the listener returns.
    """

    def __init__(
        self,
        calibration: Callable[[], RigCalibration | None],
        description: Callable[[], RigDescription],
        listener: Callable[[FusedFrame], None],
        every_s: float = 0.0,
        settings: LiveFusionSettings | None = None,
        match_colors: bool = False,
    ) -> None:
        """`calibration`: the one in force, None where there is none; asked for before every set.

        `match_colors`: cameras of different exposure are made to agree, by the first set after each change.
        """
        self._calibration, self._description, self._listener = calibration, description, listener
        self._settings, self._match_colors = settings or LiveFusionSettings(), match_colors
        self._worker = LatestOnly[PanoramicFrame]("live fusion", self._take, every_s, _NICENESS)
        self._fusion: LiveFusion | None = None
        self._made_of: tuple[RigCalibration, DepthFrame] | None = None
        self._models: dict[int, CameraModel] = {}
        self._models_s = float("-inf")
        self._report = FusionReport()
        self._fullest, self._fullest_s = 0, float("-inf")

    def report(self) -> FusionReport:
        """How it goes; any thread may ask."""
        report = replace(self._report, passed_over=self._worker.passed)
        return report if self._worker.failure is None else replace(report, trouble=self._worker.failure)

    def start(self) -> None:
        """Begin."""
        self._worker.start()

    def stop(self) -> None:
        """End, after the set that is being fused; harmless when already ended, or never begun."""
        self._worker.stop()
        self._close_fusion()

    def offer(self, panorama: PanoramicFrame) -> None:
        """Fuse this next, unless a set of more cameras has just come: cloud and panorama would flicker."""
        present, now_s = len(panorama.frames) - len(panorama.missing), time.monotonic()
        if present >= self._fullest or now_s - self._fullest_s > _FULLEST_AGE_S:
            self._fullest, self._fullest_s = present, now_s
            self._worker.offer(panorama)

    def _take(self, panorama: PanoramicFrame) -> None:
        calibration = self._calibration()
        if calibration is None:
            self._close_fusion()
            self._report = replace(self._report, trouble=None, skipped=())
            return
        self._follow(calibration, panorama)
        if self._fusion is None:
            return
        begun_s = time.perf_counter()
        fused = self._fusion.fuse(panorama)
        seconds = time.perf_counter() - begun_s
        self._report = FusionReport(self._report.fused + 1, 0, seconds, fused.skipped)
        self._listener(fused)

    def _follow(self, calibration: RigCalibration, panorama: PanoramicFrame) -> None:
        """Make the fusion anew when what it stands on has changed; its tables take half a second."""
        made_of = (calibration, _depth_frame(panorama) or self._settings.depth_frame)
        same = (
            self._made_of is not None and self._made_of[0] is calibration and self._made_of[1:] == made_of[1:]
        )
        models = self._newest_models()
        if same and _alike(models, self._models):
            return
        self._close_fusion()
        settings = replace(self._settings, depth_frame=made_of[1])
        try:
            if self._match_colors:
                settings = replace(settings, gains=frame_gains(self._description(), panorama, calibration))
            self._fusion = LiveFusion(calibration, models, settings)
        except DataError as error:  # until something changes
            self._report = replace(self._report, trouble=str(error), skipped=())
        self._made_of, self._models = made_of, models

    def _newest_models(self) -> dict[int, CameraModel]:
        if self._made_of is not None and time.monotonic() - self._models_s < _MODELS_AGE_S:
            return self._models
        self._models_s = time.monotonic()
        return {camera.id: camera.model for camera in self._description().cameras}

    def _close_fusion(self) -> None:
        if self._fusion is not None:
            self._fusion.close()
        self._fusion, self._made_of = None, None


def _depth_frame(panorama: PanoramicFrame) -> DepthFrame | None:
    """Where the set's depth images live."""
    frames = (frame for frame in panorama.frames.values() if frame is not None)
    return next((frame.depth_frame for frame in frames), None)


def _alike(models: dict[int, CameraModel], others: dict[int, CameraModel]) -> bool:
    """Whether they state the same; an agent that comes again sends its own anew."""
    return models is others or (
        models.keys() == others.keys()
        and all(models[i] is others[i] or models[i].to_dict() == others[i].to_dict() for i in models)
    )
