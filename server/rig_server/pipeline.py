"""The live pipeline: socket → link → decoder → synchroniser → panoramic frames."""

import logging
import secrets
import threading
import time
from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rig_calib.rig_calibration import RigCalibration
from rig_protocol.codecs import COLOR_CODECS, DEPTH_CODECS
from rig_protocol.errors import RigError
from rig_protocol.events import (
    Address,
    CameraJoined,
    CameraLeft,
    ControlAnswered,
    FrameReceived,
    HelloRefused,
    ServerEvent,
)
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.messages import ControlValue, Hello
from rig_protocol.recorder import RecordingStatus, TakeContext
from rig_protocol.recording_format import UTC, ClockReading, ClockTie
from rig_protocol.rig_folder import RigDescription
from rig_protocol.rig_key import RigKey
from rig_protocol.roster import Roster, Slot, known_serial
from rig_protocol.server_link import ServerLink
from rig_protocol.synchroniser import Synchroniser
from rig_protocol.system_clock import SystemClock, boot_clock_name
from rig_protocol.troubleshooting import Topic, see
from rig_server.assembler import Assembler
from rig_server.attendance import absence_message, is_whole
from rig_server.config import RigSettings
from rig_server.decoder import FrameDecoder
from rig_server.description import describe_rig
from rig_server.durations import Durations
from rig_server.link_budget import Port
from rig_server.metrics import RigStatus
from rig_server.receiver import Receiver, rig_time_ns
from rig_server.remote_control import RemoteControl
from rig_server.rig_status import StatusReader
from rig_server.stream_control import StreamControl
from rig_server.stream_planner import StreamPlanner
from rig_server.take_documents import take_documents
from rig_server.take_recording import TakeRecording
from rig_server.unassigned import UnassignedAgents

logger = logging.getLogger(__name__)

_SYSTEM_CLOCK_INTERVAL_NS = 1_000_000_000
_REFUSALS = 8  # the latest refused hellos, for the message about cameras that do not come


class LivePipeline:
    """Receives from agents between `start` and `stop`; binds its port on construction.

    Three kinds of threads: the receiver, the decoders, and whoever takes the panoramic frames.
    """

    source = "udp"
    ended = False

    def __init__(self, settings: RigSettings, key: RigKey, record: Path | None = None) -> None:
        """`record`: the file to record to."""
        self.calibration: RigCalibration | None = None
        self._settings = settings
        self._durations = Durations()
        self._assembler = Assembler(_synchroniser(settings), self._durations.set_delivered)
        planner = StreamPlanner(settings.link, len(settings.cameras) or settings.expected_cameras)
        self._link = ServerLink(
            _roster(settings),
            key,
            secrets.token_bytes,
            color_codecs=COLOR_CODECS,
            depth_codecs=DEPTH_CODECS,
            datagram_size=Port(settings.link.speed_mbit, settings.link.mtu).datagram_size,
            objection=planner.objection,
        )
        self._link.rig_clock = boot_clock_name()
        self._streams = StreamControl(self._link, planner)
        self._receiver = Receiver(
            self._link,
            settings.address,
            self._on_event,
            settings.receive_buffer_bytes,
            on_turn=self._on_turn,
        )
        self._remote = RemoteControl(self._link, self._receiver.post)
        # After the port is ours: its first construction on a machine compiles for seconds.
        self._decoder = FrameDecoder(
            self._on_frame, threads=settings.decoder_threads, demosaic=settings.demosaic
        )
        self._status = StatusReader(
            settings,
            self._link,
            self._receiver,
            self._decoder,
            self._assembler,
            self._durations,
            self._streams,
        )
        self._take = record
        self._recording = TakeRecording(settings.recording, self._take_context)
        self._system_clock = SystemClock(rig_time_ns, time.time_ns)
        self._system_clock_read_ns = 0
        self._presence = threading.Lock()  # guards what follows
        self._connected: set[int] = set()
        self._hellos: dict[int, Hello] = {}
        self._refusals: deque[HelloRefused] = deque(maxlen=_REFUSALS)
        self._unassigned = UnassignedAgents()
        self._last_join_s = time.monotonic()

    @property
    def address(self) -> Address:
        """Where agents send to."""
        return self._receiver.address

    @property
    def place(self) -> str:
        """Where agents send to, in words."""
        return "UDP {}:{}".format(*self.address)

    @property
    def hellos(self) -> dict[int, Hello]:
        """The last hello of every camera that has come so far."""
        with self._presence:
            return dict(self._hellos)

    @property
    def description(self) -> RigDescription:
        """The cameras that have come so far."""
        return describe_rig(self._settings, self.hellos)

    def start(self) -> None:
        """Start receiving, and recording before; ConfigurationError where that is not possible."""
        if self._take is not None:
            self.start_recording(self._take)
        self._receiver.start()

    def end_sets(self) -> None:
        """Say goodbye to the cameras and end all threads but that of a recording, which stays open."""
        self._receiver.stop()
        self._remote.close()
        self._decoder.close()

    def stop(self) -> None:
        """End all of it; harmless when already stopped."""
        self.end_sets()
        self.stop_recording()

    def start_recording(self, take: Path) -> None:
        """Record to a new file from now on.

        ConfigurationError when it exists or cannot be written, RigError while another recording runs.
        """
        self._recording.start(take)

    def stop_recording(self) -> RecordingStatus | None:
        """End the recording in order; how it was, None where nobody recorded."""
        return self._recording.stop()

    def absence(self) -> str | None:
        """Which expected cameras are not here and what to do, or None; RigError when receiving has failed."""
        self._check_receiver()
        with self._presence:
            since_s = time.monotonic() - self._last_join_s
            if is_whole(self._settings, self._connected, since_s):
                return None
            return absence_message(self._settings, self._connected, self._refusals)

    def next_panorama(self, timeout_s: float) -> PanoramicFrame | None:
        """The next set, or None when none came within `timeout_s`; RigError when receiving has failed."""
        self._check_receiver()
        panorama = self._assembler.next_panorama(timeout_s)
        record = self._recording.sink  # others end it
        if panorama is not None and record is not None:
            record.add_set(panorama, rig_time_ns())
        return panorama

    def status(self) -> RigStatus:
        """The rig at this moment; any thread may ask."""
        with self._presence:
            unassigned = self._unassigned.here(rig_time_ns())
        status = self._status.read(self.hellos)
        return replace(status, unassigned=unassigned, recording=self._recording.status())

    def control(
        self, cameras: int | Collection[int] | None, name: str, value: ControlValue
    ) -> Mapping[int, ControlAnswered]:
        """Have these agents, or every connected one, do something; the answers by camera id."""
        with self._presence:
            connected = set(self._connected)
        chosen = connected if cameras is None else {cameras} if isinstance(cameras, int) else cameras
        return self._remote.control(chosen, name, value)

    def assign(self, slot: Slot) -> None:
        """Give a slot to a camera, until the server ends; another one that holds it is dismissed."""
        with self._presence:
            self._unassigned.forget({slot.serial})

        def change(_now_ns: int) -> None:
            self._link.roster = self._link.roster.with_slot(slot)
            holder = self._link.cameras.get(slot.camera_id)
            if holder is not None and slot.serial not in (None, known_serial(holder.hello)):
                self._link.dismiss(slot.camera_id, f"slot {slot.camera_id} was given to another camera")

        self._receiver.post(change)

    def _check_receiver(self) -> None:
        if self._receiver.failure is not None:
            raise RigError(f"receiving stopped: {self._receiver.failure!r}") from self._receiver.failure

    def _on_frame(self, frame: RgbdFrame) -> None:
        """On a decoder's thread."""
        self._durations.frame_decoded(frame, rig_time_ns())
        self._assembler.add(frame)

    def _on_event(self, event: ServerEvent) -> None:
        """On the receiver's thread: nothing here may wait."""
        self._streams.take(event, rig_time_ns())
        match event:
            case FrameReceived(frame):
                record = self._recording.sink  # others end it
                if record is not None:
                    record.add(frame)
                self._decoder.submit(frame)
            case CameraJoined(camera_id, hello, address):
                if hello.color_codecs or hello.depth_codecs:  # sets wait for no camera that only records
                    self._assembler.camera_joined(camera_id, hello.fps)
                with self._presence:
                    self._connected.add(camera_id)
                    self._hellos[camera_id] = hello
                    self._last_join_s = time.monotonic()
                logger.info("camera %d (%s) joined from %s", camera_id, hello.name, address[0])
            case CameraLeft(camera_id, text):
                self._assembler.camera_left(camera_id)
                with self._presence:
                    self._connected.discard(camera_id)
                logger.warning("camera %d left: %s", camera_id, text, extra=see(Topic.MISSING_CAMERA))
            case ControlAnswered():
                self._remote.take(event)
            case HelloRefused(address, _, text):
                with self._presence:
                    # An agent tries on every few seconds; the operator is told once.
                    told = any(one.address[0] == address[0] and one.text == text for one in self._refusals)
                    self._refusals.append(event)
                    self._unassigned.take(event, rig_time_ns())
                level = logging.DEBUG if told else logging.WARNING
                logger.log(level, "refused %s: %s", address[0], text, extra=see(Topic.AGENT_REFUSED))

    def _documents(self) -> Mapping[str, Any]:
        """What a recording tells of the rig, as it is now."""
        return take_documents(self._settings, self.description, self.hellos, self.calibration)

    def _take_context(self) -> TakeContext:
        return TakeContext(self._documents, self._camera_counts, self._clock_reading, self._link.rig_clock)

    def _clock_reading(self) -> ClockReading | None:
        """The rig clock against the world's, where something disciplines this machine's."""
        system_clock = self._link.system_clock
        if system_clock is None or system_clock.error_ns is None:
            return None
        tie = ClockTie(UTC, system_clock.wall_minus_monotonic_ns, system_clock.error_ns)
        return ClockReading(rig_time_ns(), (tie,))

    def _camera_counts(self) -> Mapping[str, Mapping[str, int]]:
        """What came of every camera, and what was lost on the way."""
        known = dict(self._link.cameras)
        return {
            str(camera_id): {"frames": camera.counters.frames, "lost": camera.counters.lost}
            for camera_id, camera in sorted(known.items())
        }

    def _on_turn(self, now_ns: int) -> None:
        """On the receiver's thread, after every wake-up."""
        self._streams.turn(now_ns)
        if abs(now_ns - self._system_clock_read_ns) >= _SYSTEM_CLOCK_INTERVAL_NS:
            self._system_clock_read_ns = now_ns
            self._link.system_clock = self._system_clock.read()


def _synchroniser(settings: RigSettings) -> Synchroniser:
    options = settings.synchroniser
    return Synchroniser(
        (camera.id for camera in settings.cameras),
        deadline_ns=int(options.deadline_ms * 1e6),
        max_spread_ns=None if options.max_spread_ms is None else int(options.max_spread_ms * 1e6),
        policy=options.policy,
    )


def _roster(settings: RigSettings) -> Roster:
    slots = tuple(
        Slot(camera.id, camera.label, camera.serial, camera.port_path) for camera in settings.cameras
    )
    return Roster(slots, open=not slots)
