"""The way to the server: link, pacer and transport, kept going through every trouble of the network."""

import logging
import secrets
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from rig_agent.config import AgentSettings
from rig_agent.pacer import BurstGrid, Pacer
from rig_agent.transport import Transport
from rig_protocol.agent_link import AgentLink
from rig_protocol.agent_session import is_due
from rig_protocol.datagram import DatagramBatch
from rig_protocol.events import AgentEvent, Connected, ControlRequested, Disconnected, Rejected
from rig_protocol.frames import EncodedFrame
from rig_protocol.gravity import Gravity
from rig_protocol.messages import Hello, StreamPlan, Welcome
from rig_protocol.recording_format import ClockTie
from rig_protocol.rig_key import RigKey
from rig_protocol.system_clock import SystemClockReading
from rig_protocol.troubleshooting import Topic, see

_log = logging.getLogger(__name__)

# How often the name of a server that does not answer is looked up again: its address may have changed.
_REOPEN_NS = 5_000_000_000
_NO_NETWORK_RETRY_NS = 1_000_000_000
_ONE_FRAME_NS = 33_333_333
# Within a burst the kernel may send so much quicker than on average: bursts end well before the next one.
_BURST_HASTE = 4.0
_MAX_NEWS = 64  # events of one turn; the link itself keeps no more


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the server wants of this camera: codecs (None: not this stream), at most `fps` frames a second.

    Rig time is agent time and `rig_offset_ns`.
    """

    camera_id: int
    color_codec: int | None
    depth_codec: int | None
    fps: float | None = None
    rig_offset_ns: int = 0


class Uplink:
    """Sends frames to one server whenever it listens. One thread; the caller gives the time."""

    def __init__(
        self,
        settings: AgentSettings,
        rig_key: RigKey,
        read_system_clock: Callable[[], SystemClockReading] | None = None,
    ) -> None:
        """Silent until `introduce`."""
        self._rig_key = rig_key
        self._read_system_clock = read_system_clock
        self._datagram_size = settings.datagram_size
        self._transport = Transport(settings.address)
        self._pacer = Pacer(_ONE_FRAME_NS, settings.pacing.spread, settings.pacing.burst, self._cut)
        self._link: AgentLink | None = None
        self._plan: StreamPlan | None = None
        self._full_interval_ns = _ONE_FRAME_NS
        self._reopen_ns = 0
        self._refusal = ""
        self._rate = 1.0  # bytes a second that the kernel may send
        self._resent_before = 0  # by the links of cameras that were introduced before
        self._news: deque[ControlRequested | Disconnected] = deque(maxlen=_MAX_NEWS)
        self.connections = 0
        self.unheard = 0

    @property
    def welcome(self) -> Welcome | None:
        """The server's choices while it listens, else None."""
        return None if self._link is None else self._link.session

    @property
    def wanted(self) -> Wanted | None:
        """What to send now while the server listens, else None."""
        welcome = self.welcome
        if self._link is None or welcome is None:
            return None
        plan = self._link.plan
        if plan is None:
            color, depth = _first(welcome.color_codecs), _first(welcome.depth_codecs)
            return Wanted(welcome.camera_id, color, depth)
        return Wanted(welcome.camera_id, plan.color_codec, plan.depth_codec, plan.fps, plan.offset_ns)

    @property
    def rig_tie(self) -> ClockTie | None:
        """The rig clock as the server tells it, while it does."""
        plan = None if self._link is None else self._link.plan
        if plan is None or plan.rig_clock is None or plan.offset_uncertainty_ns is None:
            return None
        return ClockTie(plan.rig_clock, plan.offset_ns, plan.offset_uncertainty_ns)

    @property
    def sent(self) -> int:
        """Frames sent whole."""
        return self._pacer.counters.sent

    @property
    def dropped(self) -> int:
        """Frames given up for newer ones."""
        return self._pacer.counters.dropped

    @property
    def resent(self) -> int:
        """Datagrams that the server asked for again."""
        return self._resent_before + (0 if self._link is None else self._link.counters.resent)

    @property
    def network_errors(self) -> int:
        """Sends that the network refused."""
        return self._transport.counters.network_errors

    def introduce(self, hello: Hello, now_ns: int) -> None:
        """Say hello as this camera from now on; a session of another camera ends."""
        self._say_goodbye(now_ns)
        self._full_interval_ns = self._pacer.interval_ns = round(1e9 / hello.fps)
        self._link = AgentLink(hello, self._rig_key, secrets.token_bytes, self._datagram_size)

    def report_health(self, gauges: Mapping[str, float]) -> None:
        """What the next heartbeats tell the server."""
        if self._link is not None:
            self._link.report_health(gauges)

    def report_gravity(self, gravity: Gravity | None) -> None:
        """Down as the camera feels it now; the next heartbeats tell the server."""
        if self._link is not None:
            self._link.gravity = gravity

    def next_news(self) -> ControlRequested | Disconnected | None:
        """The oldest control, or end of a session, that was not fetched yet."""
        return self._news.popleft() if self._news else None

    def answer_control(self, request: ControlRequested, done: bool, text: str) -> None:
        """Tell the server what became of a control."""
        if self._link is not None:
            self._link.answer_control(request, done, text)

    def fileno(self) -> int | None:
        """For a selector; changes when the transport opens anew."""
        return self._transport.fileno()

    def send_frame(self, frame: EncodedFrame, now_ns: int) -> None:
        """Queue a frame for sending; dropped, and counted in `unheard`, while nobody listens."""
        if self._link is None or not self._link.connected:
            self.unheard += 1
            return
        given_up = self._pacer.submit(frame, now_ns)
        if given_up is not None:
            self._link.give_up_frame(given_up)

    def serve(self, now_ns: int) -> None:
        """Receive what came, do what is due, send what is due."""
        if self._link is None:
            return
        for datagram in self._transport.receive():
            self._link.receive_datagram(datagram, now_ns)
        due_ns = self._link.next_timeout_ns()
        if due_ns is not None and due_ns <= now_ns:
            self._link.handle_timeout(now_ns)
        while (event := self._link.next_event()) is not None:
            self._report(event)
        if not self._link.connected and is_due(self._reopen_ns, now_ns, _REOPEN_NS):
            self._reopen_ns = now_ns + (_REOPEN_NS if self._transport.open() else _NO_NETWORK_RETRY_NS)
        self._send_control(self._link, now_ns)
        self._follow_plan(self._link.plan)
        self._send_frames(self._link, now_ns)

    def next_timeout_ns(self) -> int | None:
        """When `serve` is due again, if nothing arrives before."""
        if self._link is None:
            return None
        reopen_ns = None if self._link.connected else self._reopen_ns
        times = (self._link.next_timeout_ns(), self._pacer.next_timeout_ns(), reopen_ns)
        return min((time for time in times if time is not None), default=None)

    def close(self, now_ns: int) -> None:
        """Say goodbye and close the socket."""
        self._say_goodbye(now_ns)
        self._transport.close()

    def _send_control(self, link: AgentLink, now_ns: int) -> None:
        system_clock = self._read_system_clock() if link.answers_clock and self._read_system_clock else None
        for datagram in link.datagrams_to_send(now_ns, system_clock):
            self._transport.send_datagram(datagram)

    def _send_frames(self, link: AgentLink, now_ns: int) -> None:
        for batch in link.frames_to_resend(self._pacer.sent_of):
            self._pacer.resend(batch)
        while (again := self._pacer.next_resend(now_ns)) is not None:
            self._transport.send(again)
        burst = self._pacer.next_burst(now_ns)
        if burst is not None:
            self._pacer.sent(self._transport.send(burst), now_ns)

    def _follow_plan(self, plan: StreamPlan | None) -> None:
        """Pace as the server wants from the next frame on."""
        if plan is self._plan:
            return
        self._plan = plan
        self._pacer.grid = None if plan is None else _grid(plan)
        planned_ns = 0 if plan is None else round(1e9 / plan.fps)
        self._pacer.interval_ns = max(self._full_interval_ns, planned_ns)

    def _cut(self, frame: EncodedFrame, now_ns: int) -> DatagramBatch | None:
        batch = None if self._link is None else self._link.send_frame(frame, now_ns)
        if batch is None:
            self.unheard += 1
        else:
            self._limit_rate(batch.total_bytes)
        return batch

    def _limit_rate(self, frame_bytes: int) -> None:
        """Tell the kernel when the frames' rate has changed by a quarter."""
        rate = _BURST_HASTE * frame_bytes * 1e9 / self._pacer.interval_ns
        if not 0.8 < rate / self._rate < 1.25:
            self._rate = rate
            self._transport.limit_rate(rate)

    def _say_goodbye(self, now_ns: int) -> None:
        self._pacer.clear()
        if self._link is None:
            return
        self._link.close(now_ns)
        for datagram in self._link.datagrams_to_send(now_ns):
            self._transport.send_datagram(datagram)
        self._resent_before += self._link.counters.resent
        self._link = None

    def _report(self, event: AgentEvent) -> None:
        """Tell the operator what has changed; a refusal that repeats is told once."""
        match event:
            case Connected(welcome):
                self.connections += 1
                self._refusal = ""
                self._transport.server_reached()
                _log.info("connected to %s as camera %d", self._transport.server, welcome.camera_id)
            case Rejected(reason, text):
                if text != self._refusal:
                    _log.error(
                        "%s refuses this camera (%s): %s; trying on",
                        self._transport.server,
                        reason.name,
                        text,
                        extra=see(Topic.AGENT_REFUSED),
                    )
                self._refusal = text
            case Disconnected(text):
                self._pacer.clear()
                self._news.append(event)
                server = self._transport.server
                _log.warning("lost %s: %s; trying on", server, text, extra=see(Topic.SERVER_SILENT))
            case ControlRequested():
                self._news.append(event)


def _grid(plan: StreamPlan) -> BurstGrid:
    return BurstGrid(plan.step_ns, (plan.phase_ns - plan.offset_ns) % plan.step_ns, plan.spread)


def _first(codecs: tuple[int, ...]) -> int | None:
    return codecs[0] if codecs else None
