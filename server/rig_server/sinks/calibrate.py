"""The calibrating sink: collects the panoramic frames to calibrate on."""

from collections.abc import Iterable, Sequence

from rig_protocol.errors import RigError
from rig_protocol.frames import PanoramicFrame
from rig_protocol.troubleshooting import Topic


class CalibrateSink:
    """Wants `count` sets that hold an undamaged frame of each of the `cameras`.

    Keeps the least incomplete of the others for want of better.
    """

    def __init__(self, count: int, cameras: Iterable[int]) -> None:
        self._count = count
        self._cameras = tuple(cameras)
        self._complete: list[PanoramicFrame] = []
        self._partial: list[PanoramicFrame] = []

    def take(self, panorama: PanoramicFrame) -> bool:
        """Keep the set; False when there are enough complete ones."""
        if not self._lacking(panorama):
            self._complete.append(panorama)
        else:
            best_first = sorted([*self._partial, panorama], key=lambda one: len(self._lacking(one)))
            self._partial = best_first[: self._count]
        return len(self._complete) < self._count

    @property
    def complete(self) -> int:
        """How many complete sets there are."""
        return len(self._complete)

    def first(self, count: int) -> list[PanoramicFrame]:
        """The first `count` complete sets, or as many as there are."""
        return self._complete[:count]

    def chosen(self) -> tuple[list[PanoramicFrame], tuple[str, ...]]:
        """The sets to calibrate on, and a warning where partial ones had to do; RigError for none at all."""
        if not (self._complete or self._partial):
            raise RigError(
                "the cameras are connected but no frame has arrived: look at `journalctl -u 'rig-agent@*'` "
                "on their machines",
                Topic.NO_FRAMES,
            )
        spare = self._partial[: self._count - len(self._complete)]
        chosen = sorted([*self._complete, *spare], key=lambda panorama: panorama.index)
        return chosen, self._warnings(len(chosen), spare)

    def _lacking(self, panorama: PanoramicFrame) -> list[int]:
        """Cameras of which the set holds no frame, or a damaged one."""
        frames = ((camera_id, panorama.frames.get(camera_id)) for camera_id in self._cameras)
        return [camera_id for camera_id, frame in frames if frame is None or frame.damaged]

    def _warnings(self, frames: int, spare: Sequence[PanoramicFrame]) -> tuple[str, ...]:
        if not spare:
            return ()
        lacking = sorted({camera_id for panorama in spare for camera_id in self._lacking(panorama)})
        warning = (
            f"{len(spare)} of {frames} panoramic frames were partial: complete sets did not come in time; "
            f"missing or damaged at times: cameras {', '.join(map(str, lacking))}"
        )
        return (warning,)
