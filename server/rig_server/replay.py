"""A recorded take as panoramic frames: the sets that went out when it was recorded, frame for frame."""

import logging
import threading
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from rig_calib.recorded_calibration import recorded_calibration
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.codecs import keep_freed_memory
from rig_protocol.decoding import decode_frame
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import EncodedFrame, PanoramicFrame, RgbdFrame
from rig_protocol.messages import Hello
from rig_protocol.recorded_hellos import recorded_hellos
from rig_protocol.recorded_sets import EncodedSet, synchroniser_of, with_frames, with_sets
from rig_protocol.recorder import RecordingStatus, TakeContext
from rig_protocol.recording import HELLOS, Recording
from rig_protocol.recording_format import Entry
from rig_protocol.rig_folder import RigDescription
from rig_server.config import RigSettings
from rig_server.metrics import CameraMetrics, RateMeter, RigStatus
from rig_server.pace import Pace
from rig_server.receiver import rig_time_ns
from rig_server.take_documents import take_documents
from rig_server.take_recording import TakeRecording
from rig_server.unattended import Unattended

logger = logging.getLogger(__name__)

_LEAD_IN_NS = 2_000_000_000  # frames of the first set after a seek came before it
_BETWEEN_ROUNDS_NS = 33_333_333  # a looped take begins anew so long after its last set


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """How to play: `speed` times that of the recording, None for as fast as sets are taken; from where."""

    speed: float | None = 1.0
    loop: bool = False
    seek_s: float = 0.0


class ReplayedRig(Unattended):
    """The sets of a take, at the pace at which they went out; one thread takes them.

    A consumer that is slower gets every set, later. What is played can be recorded: the frames as they are in
    the take, at their own times; a slow disk holds the play up. ConfigurationError when there is no such
    file, DataError when it is no recording, is damaged, or tells no cameras.
    """

    source = "recording"

    def __init__(
        self, take: Path, settings: RigSettings, options: ReplayOptions, record: Path | None = None
    ) -> None:
        """`record`: the file to record to."""
        self._recording, self._settings, self._options = Recording(take), settings, options
        self.description: RigDescription = self._recording.description
        self.hellos: dict[int, Hello] = recorded_hellos(self._recording.document(HELLOS), self.description)
        self.calibration = _calibration_of(self._recording)
        self._has_sets = self._recording.has_sets
        span_s = (self._recording.end_ns - self._recording.start_ns) / 1e9
        if not options.seek_s <= span_s:  # no number is beyond it, too
            raise ConfigurationError(f"--seek {options.seek_s:g}: {take} lasts {span_s:.1f} s")
        for part in self._recording.torn:
            logger.warning("%s was not finished: it is read as far as it goes", part)
        keep_freed_memory()
        self._decoders = ThreadPoolExecutor(settings.decoder_threads, thread_name_prefix="decoder")
        self._record = record
        self._copy = TakeRecording(settings.recording, self._take_context)
        self._now_ns = self._recording.start_ns  # in the take
        self._coming: EncodedSet | None = None
        self._pace = Pace(options.speed)
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
        """Start recording, where that is asked for; ConfigurationError when it is not possible."""
        if self._record is not None:
            self.start_recording(self._record)

    def end_sets(self) -> None:
        """End the decoders; harmless when already ended."""
        self.ended = True
        self._decoders.shutdown(cancel_futures=True)

    def stop(self) -> None:
        """End all of it; harmless when already stopped."""
        self.end_sets()
        self.stop_recording()

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
        if not self._pace.wait(self._coming.time_ns, timeout_s) or not self._room(timeout_s):
            return None
        coming, self._coming = self._coming, None
        panorama = self._decoded(coming)
        self._keep(coming, panorama)
        return panorama

    def start_recording(self, take: Path) -> None:
        """Record what is played to a new file from now on.

        ConfigurationError when it exists or cannot be written, RigError while another recording runs.
        """
        self._copy.start(take)

    def stop_recording(self) -> RecordingStatus | None:
        """End the recording in order; how it was, None where nobody recorded."""
        return self._copy.stop()

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
                tuple(cameras),
                self._complete,
                self._partial,
                sets_per_s=sets[0],
                recording=self._copy.status(),
                turns=self._turns,
            )

    def _played_sets(self) -> Iterator[EncodedSet]:
        """The sets from where to begin, and with `loop` again and again, indices and times going on."""
        index, shift_ns = 0, 0
        from_ns = self._recording.start_ns + int(self._options.seek_s * 1e9)
        while True:
            first = last = None
            for one in with_frames(self._entries(max(0, from_ns - _LEAD_IN_NS)), from_ns):
                yield _later(one, index, shift_ns)
                first, last = first or one, one
            if first is None or last is None or not self._options.loop:
                return
            self._pace.restart(last.time_ns + shift_ns)
            index += last.index + 1
            exposed_ns = max(_exposures_ns(last)) - min(_exposures_ns(first))
            shift_ns += max(last.time_ns - first.time_ns, exposed_ns) + _BETWEEN_ROUNDS_NS

    def _room(self, timeout_s: float) -> bool:
        """Whether a recording, if there is one, has room for another set; waits for it."""
        record = self._copy.sink  # others end it
        return record is None or record.status().ended is not None or record.wait_for_room(timeout_s)

    def _keep(self, one: EncodedSet, panorama: PanoramicFrame | None) -> None:
        """Record what was played."""
        self._now_ns = one.time_ns
        record = self._copy.sink
        if record is None:
            return
        for frame in one.frames.values():
            if frame is not None:
                record.add(frame)
        if panorama is not None:
            record.add_set(panorama, one.time_ns)

    def _take_context(self) -> TakeContext:
        """What a recording of this one tells: cameras, clock and date, and the calibration in force."""
        return TakeContext(self._documents, clock=self._recording.clock, moment=self._moment)

    def _documents(self) -> Mapping[str, Any]:
        return take_documents(self._settings, self.description, self.hellos, self.calibration)

    def _moment(self) -> tuple[str, int]:
        """When what is played was captured: in UTC and in the take's clock; 0 where nobody knows."""
        offset_ns = self._recording.utc_minus_rig_time_ns
        if offset_ns is None:
            return "", 0
        try:
            utc = datetime.fromtimestamp((self._now_ns + offset_ns) / 1e9, UTC)
        except (ValueError, OverflowError, OSError):  # a date out of reason
            return "", 0
        return utc.isoformat(timespec="seconds"), self._now_ns

    def _entries(self, from_ns: int) -> Iterator[Entry]:
        entries = self._recording.entries(from_ns)
        if self._has_sets:
            return entries
        options = self._settings.synchroniser
        spread_ns = None if options.max_spread_ms is None else int(options.max_spread_ms * 1e6)
        deadline_ns = int(options.deadline_ms * 1e6)
        return with_sets(entries, synchroniser_of(self.hellos, deadline_ns, spread_ns, options.policy))

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


def _exposures_ns(one: EncodedSet) -> list[int]:
    return [frame.timestamp_ns for frame in one.frames.values() if frame is not None]


def _later(one: EncodedSet, index: int, shift_ns: int) -> EncodedSet:
    """The same set by so many indices, and by so much time, later."""
    if not shift_ns:
        return EncodedSet(one.index + index, one.time_ns, one.frames)
    frames = {
        camera_id: frame
        and replace(
            frame,
            timestamp_ns=frame.timestamp_ns + shift_ns,
            received_ns=None if frame.received_ns is None else frame.received_ns + shift_ns,
        )
        for camera_id, frame in one.frames.items()
    }
    return EncodedSet(one.index + index, one.time_ns + shift_ns, frames)


def _calibration_of(recording: Recording) -> RigCalibration | None:
    """The one that the take brings; one that cannot be read is no reason not to play its images."""
    try:
        return recorded_calibration(recording)
    except DataError as error:
        logger.warning("%s; the take plays without it", error)
        return None


def _decode(frame: EncodedFrame | None, demosaic: bool) -> RgbdFrame | None:
    if frame is None:
        return None
    try:
        return decode_frame(frame, demosaic)
    except DataError as error:
        logger.warning("camera %d, frame %d is left out: %s", frame.camera_id, frame.sequence, error)
        return None
