"""A recorded take as panoramic frames: the sets that went out when it was recorded, frame for frame."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rig_calib.recorded_calibration import recorded_calibration
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.codecs import keep_freed_memory
from rig_protocol.decoding import decode_frame
from rig_protocol.errors import ConfigurationError, DataError, RigError
from rig_protocol.events import ControlAnswered
from rig_protocol.frames import EncodedFrame, PanoramicFrame, RgbdFrame
from rig_protocol.messages import ControlValue, Hello
from rig_protocol.recorded_sets import EncodedSet, with_frames
from rig_protocol.recording import HELLOS, Recording
from rig_protocol.recording_format import Entry, RecordedSet, time_of
from rig_protocol.rig_folder import RigDescription
from rig_protocol.roster import Slot
from rig_server.config import RigSettings
from rig_server.metrics import CameraMetrics, RateMeter, RigStatus
from rig_server.receiver import rig_time_ns
from rig_server.synchroniser import Synchroniser
from rig_server.take_documents import recorded_hellos

logger = logging.getLogger(__name__)

_LEAD_IN_NS = 2_000_000_000  # frames of the first set after a seek came before it


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """How to play: `speed` times that of the recording, None for as fast as sets are taken; from where."""

    speed: float | None = 1.0
    loop: bool = False
    seek_s: float = 0.0


class ReplayedRig:
    """The sets of a take, at the pace at which they went out; one thread takes them.

    A consumer that is slower gets every set, later. ConfigurationError when there is no such file, DataError
    when it is no recording, is damaged, or tells no cameras.
    """

    source = "recording"

    def __init__(self, take: Path, settings: RigSettings, options: ReplayOptions) -> None:
        self._recording, self._settings, self._options = Recording(take), settings, options
        self.description: RigDescription = self._recording.description
        self.hellos: dict[int, Hello] = recorded_hellos(self._recording.document(HELLOS), self.description)
        self.calibration = _calibration_of(self._recording)
        self._has_sets = self._recording.has_sets
        span_s = (self._recording.end_ns - self._recording.start_ns) / 1e9
        if options.seek_s > span_s:
            raise ConfigurationError(f"--seek {options.seek_s:g}: {take} lasts {span_s:.1f} s")
        for part in self._recording.torn:
            logger.warning("%s was not finished: it is read as far as it goes", part)
        keep_freed_memory()
        self._decoders = ThreadPoolExecutor(settings.decoder_threads, thread_name_prefix="decoder")
        self._coming: EncodedSet | None = None
        self._pace = _Pace(options.speed)
        self._sets = self._played_sets()
        self.ended = False
        self._counting = threading.Lock()  # guards what follows: others ask for the status
        self._frames: Counter[int] = Counter()
        self._damaged: Counter[int] = Counter()
        self._complete = self._partial = self._turns = 0
        self._rates, self._set_rates = RateMeter(), RateMeter()

    @property
    def place(self) -> str:
        """Where the frames come from, in words."""
        return f"recording {self._recording.path}"

    def start(self) -> None:
        """A file is always there."""

    def end_sets(self) -> None:
        """End the decoders; harmless when already ended."""
        self.stop()

    def stop(self) -> None:
        """End the decoders; harmless when already ended."""
        self.ended = True
        self._decoders.shutdown(cancel_futures=True)

    def absence(self) -> None:
        """Every camera of the take is here."""

    def next_panorama(self, timeout_s: float) -> PanoramicFrame | None:
        """The next set, when it is due; None when that is later or it ends. DataError for a damaged file."""
        self._turns += 1
        if self.ended:
            return None
        if self._coming is None:
            self._coming = next(self._sets, None)
        if self._coming is None:
            self.ended = True
            return None
        if not self._pace.wait(self._coming.time_ns, timeout_s):
            return None
        coming, self._coming = self._coming, None
        return self._decoded(coming)

    def control(
        self,
        cameras: int | Collection[int] | None,  # noqa: ARG002  # as every feed has it
        name: str,
        value: ControlValue,  # noqa: ARG002
    ) -> Mapping[int, ControlAnswered]:
        """A recording cannot be told anything: RigError."""
        raise RigError(f"{self.place} is no live rig: nobody is there to set {name}")

    def assign(self, slot: Slot) -> None:
        """A recording's cameras are what they are: RigError."""
        raise RigError(f"{self.place} is no live rig: slot {slot.camera_id} cannot be given away")

    def start_recording(self, take: Path) -> None:
        """What was captured already is not recorded again: RigError."""
        raise RigError(f"{self.place} is no live rig: copy it instead of recording {take}")

    def stop_recording(self) -> None:
        """Nobody records."""

    def status(self) -> RigStatus:
        """Cameras and sets given so far, and their rates; any thread may ask."""
        with self._counting:
            now_ns = rig_time_ns()
            counts = {camera.id: self._frames[camera.id] for camera in self.description.cameras}
            rates = self._rates.update(counts, now_ns)
            sets = self._set_rates.update({0: self._complete + self._partial}, now_ns)
            cameras = (
                CameraMetrics(
                    camera.id,
                    camera.name,
                    connected=True,
                    fps=rates[camera.id],
                    frames=counts[camera.id],
                    damaged=self._damaged[camera.id],
                )
                for camera in self.description.cameras
            )
            return RigStatus(
                tuple(cameras), self._complete, self._partial, sets_per_s=sets[0], turns=self._turns
            )

    def _played_sets(self) -> Iterator[EncodedSet]:
        """The sets from where to begin, and with `loop` again and again, their indices counting on."""
        base, from_ns = 0, self._recording.start_ns + int(self._options.seek_s * 1e9)
        while True:
            last = None
            self._pace.restart()
            for one in with_frames(self._entries(max(0, from_ns - _LEAD_IN_NS)), from_ns):
                yield EncodedSet(base + one.index, one.time_ns, one.frames)
                last = one.index
            if last is None or not self._options.loop:
                return
            base += last + 1

    def _entries(self, from_ns: int) -> Iterator[Entry]:
        entries = self._recording.entries(from_ns)
        if self._has_sets:
            return entries
        options = self._settings.synchroniser
        synchroniser = Synchroniser(
            self.description.camera_ids,
            deadline_ns=int(options.deadline_ms * 1e6),
            max_spread_ns=None if options.max_spread_ms is None else int(options.max_spread_ms * 1e6),
            policy=options.policy,
        )
        for camera_id, hello in self.hellos.items():
            synchroniser.camera_joined(camera_id, hello.fps)
        return with_sets(entries, synchroniser)

    def _decoded(self, one: EncodedSet) -> PanoramicFrame | None:
        decode = partial(_decode, demosaic=self._settings.demosaic)
        frames = dict(zip(one.frames, self._decoders.map(decode, one.frames.values()), strict=True))
        if not any(frames.values()):
            return None
        panorama = PanoramicFrame.of(one.index, frames)
        with self._counting:
            self._complete += panorama.complete
            self._partial += not panorama.complete
            present = [frame for frame in frames.values() if frame is not None]
            self._frames.update(frame.camera_id for frame in present)
            self._damaged.update(frame.camera_id for frame in present if frame.damaged)
        return panorama


def _calibration_of(recording: Recording) -> RigCalibration | None:
    """The one that the take brings; one that cannot be read is no reason not to play its images."""
    try:
        return recorded_calibration(recording)
    except DataError as error:
        logger.warning("%s; the take plays without it", error)
        return None


def with_sets(entries: Iterable[Entry], synchroniser: Synchroniser) -> Iterator[Entry]:
    """The entries of a take without sets, and the sets that the synchroniser makes, in recorded time."""
    now_ns = 0
    for entry in entries:
        yield entry
        if isinstance(entry, EncodedFrame):
            now_ns = max(now_ns, time_of(entry))
            synchroniser.add(_without_images(entry), now_ns)
            yield from _sets_due(synchroniser, now_ns)
    while synchroniser.waiting and (due_ns := synchroniser.next_timeout_ns()) is not None:
        waiting, now_ns = synchroniser.waiting, max(now_ns, due_ns)
        yield from _sets_due(synchroniser, now_ns)
        if synchroniser.waiting == waiting:
            return


def _sets_due(synchroniser: Synchroniser, now_ns: int) -> Iterator[RecordedSet]:
    while (panorama := synchroniser.next_panorama(now_ns)) is not None:
        yield RecordedSet.of(panorama, now_ns)


def _without_images(frame: EncodedFrame) -> RgbdFrame:
    return RgbdFrame(frame.camera_id, frame.sequence, frame.timestamp_ns, frame.uncertainty_ns)


def _decode(frame: EncodedFrame | None, demosaic: bool) -> RgbdFrame | None:
    if frame is None:
        return None
    try:
        return decode_frame(frame, demosaic)
    except DataError as error:
        logger.warning("camera %d, frame %d is left out: %s", frame.camera_id, frame.sequence, error)
        return None


class _Pace:
    """When what was recorded at some time is due."""

    def __init__(self, speed: float | None) -> None:
        self._speed = speed
        self._begun: tuple[float, int] | None = None

    def restart(self) -> None:
        """The next one is due at once."""
        self._begun = None

    def wait(self, time_ns: int, timeout_s: float) -> bool:
        """Wait until it is due, but no longer than `timeout_s`; False when it is not due then."""
        if self._speed is None:
            return True
        now_s = time.monotonic()
        begun_s, begun_ns = self._begun = self._begun or (now_s, time_ns)
        wait_s = begun_s + (time_ns - begun_ns) / 1e9 / self._speed - now_s
        time.sleep(max(0.0, min(wait_s, timeout_s)))
        return wait_s <= timeout_s
