"""The agent: source → encoder → link → pacer → transport, and → recorder.

Three threads, so that nothing holds up the camera: capture reads frames, the encoder packs them, the
network loop (the caller's thread) sends them. Between them stand queues that drop the oldest frame. A fourth
writes the take, where one is recorded: every frame, whatever the server wants.
"""

import logging
import os
import select
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

from rig_agent.capture import Capture
from rig_agent.config import AgentSettings
from rig_agent.encoder import codecs_to_keep, encode_frame, fits
from rig_agent.frame_queue import FrameQueue
from rig_agent.health import HealthLog, Totals, gauges
from rig_agent.hello import make_hello
from rig_agent.remote_control import RemoteControl
from rig_agent.sources.base import FrameSource, SourceDescription
from rig_agent.take_recording import TakeRecording
from rig_agent.transport import now_ns
from rig_agent.unix_socket import send_to_unix_socket
from rig_agent.uplink import Uplink, Wanted
from rig_protocol.agent_session import is_due
from rig_protocol.errors import RigError
from rig_protocol.events import ControlRequested
from rig_protocol.frames import EncodedFrame, RgbdFrame
from rig_protocol.messages import Hello
from rig_protocol.rig_key import RigKey
from rig_protocol.service_manager import ServiceManager
from rig_protocol.system_clock import SystemClock
from rig_protocol.troubleshooting import Topic, see

_log = logging.getLogger(__name__)

_QUEUE_FRAMES = 2  # covers one hiccup of the next stage; older frames are stale
_RECORDED_QUEUE_FRAMES = 16  # of those that are recorded none is: half a second, 15 MB
_GAUGES_INTERVAL_NS = 1_000_000_000
_TICK_S = 0.2  # how soon a thread notices that it should end
_HUNG_NS = 60_000_000_000  # a driver call that takes longer will not return
_LONGEST_TURN_NS = 1_000_000_000
_STOP_TIMEOUT_S = 5.0  # closing a Kinect takes a few seconds at most


@dataclass(frozen=True, slots=True)
class _Shot:
    """A captured frame; `number` counts all of them, the frame's own sequence those that are `wanted`."""

    frame: RgbdFrame
    number: int
    wanted: bool


class Agent:
    """Streams one camera to one server until it is told to stop, come what may, and may record it."""

    def __init__(
        self, settings: AgentSettings, rig_key: RigKey | None, open_source: Callable[[], FrameSource]
    ) -> None:
        """Nothing runs before `run`. Without a key there is no server: it only records.

        ConfigurationError where the settings say to record and that is not possible.
        """
        self._settings = settings
        path = settings.record.path
        self._take = None if path is None else TakeRecording(settings, path)
        self._captured: FrameQueue[_Shot] = FrameQueue(
            _QUEUE_FRAMES if self._take is None else _RECORDED_QUEUE_FRAMES
        )
        self._left_out = 0  # captured frames that the server does not want
        self._encoded: FrameQueue[EncodedFrame] = FrameQueue(_QUEUE_FRAMES)
        self._capture = Capture(
            open_source, settings.fps, self._source_opened, self._take_frame, self._fail, self._leave_out
        )
        self._remote = RemoteControl(self._capture, self._wake_up)
        self._encoder = threading.Thread(target=self._encode_frames, name="encoder", daemon=True)
        self._has_server = rig_key is not None
        self._uplink = Uplink(settings, rig_key or RigKey.INSECURE, SystemClock(now_ns, time.time_ns).read)
        self._service_manager = ServiceManager(send_to_unix_socket)
        self._hello: Hello | None = None  # of the source that is open now
        self._introduced: Hello | None = None
        self._wanted: Wanted | None = None  # what the encoder encodes for; None: nobody listens
        self._unheard = 0
        self.restarts = False
        """True when `run` ended for the program to start anew."""
        self._failure: Exception | None = None
        self._stopping = threading.Event()
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    @property
    def totals(self) -> Totals:
        """Counts of all stages since the start."""
        capture, uplink = self._capture.counters, self._uplink
        return Totals(
            captured=capture.captured,
            sent=uplink.sent,
            dropped=self._captured.dropped + self._encoded.dropped + uplink.dropped,
            unheard=self._unheard + uplink.unheard,
            damaged=capture.damaged,
            resent=uplink.resent,
            connections=uplink.connections,
            source_losses=capture.losses,
            network_errors=uplink.network_errors,
            source=self._capture.source_counters,
            recording=None if self._take is None else self._take.status(),
        )

    def run(self) -> None:
        """Run until `stop`, or until something fails that no new attempt cures.

        Either way the server is told goodbye and the source is closed.
        """
        if self._take is not None:
            self._take.start()
        self._capture.start()
        self._encoder.start()
        try:
            self._serve_network()
        finally:
            self._shut_down()
        if self._failure is not None:
            raise self._failure

    def stop(self) -> None:
        """End `run`, from any thread or signal handler."""
        self._stopping.set()
        self._wake_up()

    # ---- network loop: the caller's thread

    def _serve_network(self) -> None:
        time_ns = gauges_due_ns = now_ns()
        health = HealthLog(self._settings.report_interval_s, time_ns)
        hang = _Hang()
        self._service_manager.notify("READY=1")
        while not self._stopping.is_set():
            self._wait(time_ns)
            time_ns = now_ns()
            self._forward(time_ns)
            self._service_manager.feed_watchdog(time_ns)
            if is_due(gauges_due_ns, time_ns, _GAUGES_INTERVAL_NS):
                gauges_due_ns = time_ns + _GAUGES_INTERVAL_NS
                self._uplink.report_health(gauges(self.totals))
            if is_due(health.due_ns, time_ns, health.interval_ns):
                _log.info("%s", health.line(self.totals, self._wanted is not None, time_ns))
            if self._remote.restart_due(time_ns):
                self.restarts = True
                return
            if hang.lasts(self._capture.last_sign_ns, time_ns):
                raise RigError(
                    f"the {self._settings.source} driver hangs: start the agent anew", Topic.HANGING_KINECT
                )

    def _wait(self, time_ns: int) -> None:
        """Sleep until a datagram or a frame comes or something is due."""
        due_ns = self._uplink.next_timeout_ns()
        timeout_s = _TICK_S if due_ns is None else min(max(due_ns - time_ns, 0) / 1e9, _TICK_S)
        descriptors = [fd for fd in (self._wake, self._uplink.fileno()) if fd is not None]
        # select counts in microseconds; epoll would round the pacer's steps up to whole milliseconds.
        if self._wake in select.select(descriptors, [], [], timeout_s)[0]:
            os.eventfd_read(self._wake)

    def _forward(self, time_ns: int) -> None:
        hello = self._hello
        if self._has_server and hello is not None and hello is not self._introduced:
            self._introduced = hello
            self._uplink.introduce(hello, time_ns)
        self._uplink.report_gravity(self._capture.gravity)
        while (answer := self._remote.next_answer()) is not None:
            self._uplink.answer_control(*answer)
        # Control first: cutting a frame takes a millisecond, which the clock exchange would feel.
        self._uplink.serve(time_ns)
        while (news := self._uplink.next_news()) is not None:
            if isinstance(news, ControlRequested):
                self._remote.take(news, time_ns)
            else:
                self._remote.session_ended()
        if self._take is not None:
            self._take.rig_tie = self._uplink.rig_tie
        self._wanted = self._uplink.wanted
        if self._wanted is not None:
            self._capture.want(self._wanted.fps, self._wanted.rig_offset_ns)
        while (frame := self._encoded.get()) is not None:
            self._uplink.send_frame(frame, time_ns)

    def _shut_down(self) -> None:
        self._stopping.set()
        self._service_manager.notify("STOPPING=1")
        self._uplink.close(now_ns())
        ended = self._capture.stop(_STOP_TIMEOUT_S)
        if not ended:
            _log.warning(
                "the %s driver does not return; leaving without it",
                self._settings.source,
                extra=see(Topic.HANGING_KINECT),
            )
        self._encoder.join()
        if self._take is not None:
            self._take.stop()
        if ended:
            os.close(self._wake)

    # ---- what the other threads do and say

    def _encode_frames(self) -> None:
        try:
            while not self._stopping.is_set():
                shot, wanted = self._captured.get(_TICK_S), self._wanted
                if shot is None:
                    continue
                kept = self._record(shot)
                if shot.wanted and self._settings.streams:
                    self._encode_to_send(shot.frame, wanted, kept)
        except Exception as error:  # the thread's boundary: `run` raises it
            self._fail(error)

    def _record(self, shot: _Shot) -> EncodedFrame | None:
        """Give a frame to the recorder, lossless; what it was encoded to."""
        if self._take is None:
            return None
        color, depth = codecs_to_keep(shot.frame, self._settings.color, self._settings.depth)
        encoded = encode_frame(shot.frame, color, depth)
        self._take.add(replace(encoded, sequence=shot.number, gravity=shot.frame.gravity))
        return encoded

    def _encode_to_send(self, frame: RgbdFrame, wanted: Wanted | None, kept: EncodedFrame | None) -> None:
        if wanted is None or not fits(frame, wanted.color_codec, wanted.depth_codec):
            self._unheard += 1  # nobody listens, or not yet to a camera that was switched
            return
        named = replace(frame, camera_id=wanted.camera_id)
        self._encoded.put(encode_frame(named, wanted.color_codec, wanted.depth_codec, kept))
        self._wake_up()

    def _take_frame(self, frame: RgbdFrame) -> None:
        self._enqueue(_Shot(frame, frame.sequence + self._left_out, wanted=True))

    def _leave_out(self, frame: RgbdFrame) -> None:
        """The server does not want this one; a recording does."""
        if self._take is not None:
            self._enqueue(_Shot(frame, frame.sequence + self._left_out, wanted=False))
        self._left_out += 1

    def _enqueue(self, shot: _Shot) -> None:
        dropped = self._captured.put(shot)
        if dropped is not None and self._take is not None:
            self._take.add_dropped(dropped.frame.timestamp_ns)

    def _source_opened(self, description: SourceDescription) -> None:
        """A device that came back as it was keeps its session; another one says hello anew."""
        if self._take is not None:
            self._take.describe(description)
        hello = make_hello(self._settings, description, self._settings.streams)
        if self._hello is None or not _same(hello, self._hello):
            self._hello = hello
            self._wake_up()

    def _fail(self, error: Exception) -> None:
        self._failure = error
        self.stop()

    def _wake_up(self) -> None:
        os.eventfd_write(self._wake, 1)


class _Hang:
    """Whether a driver hangs, by this loop's own turns: a jumping clock or a stopped program is no hang."""

    def __init__(self) -> None:
        self._sign_ns = self._last_ns = 0
        self._silent_ns = 0

    def lasts(self, sign_ns: int, time_ns: int) -> bool:
        """True when no new sign has come for too long; called at every turn."""
        passed_ns = min(max(time_ns - self._last_ns, 0), _LONGEST_TURN_NS)
        self._silent_ns = self._silent_ns + passed_ns if sign_ns == self._sign_ns else 0
        self._sign_ns, self._last_ns = sign_ns, time_ns
        return self._silent_ns > _HUNG_NS


def _same(one: Hello, other: Hello) -> bool:
    """True when two hellos say the same; camera models are compared by their numbers."""
    names = [field.name for field in fields(Hello) if field.name != "model"]
    said = [[getattr(hello, name) for name in names] for hello in (one, other)]
    return said[0] == said[1] and one.model.to_dict() == other.model.to_dict()
