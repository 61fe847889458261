"""The way to the server: link, pacer and transport, kept going through every trouble of the network."""

import logging
import secrets
from collections.abc import Mapping

from rig_agent.config import AgentSettings
from rig_agent.pacer import Pacer
from rig_agent.transport import Transport
from rig_protocol.agent_link import AgentLink
from rig_protocol.events import AgentEvent, Connected, Disconnected, Rejected
from rig_protocol.frames import EncodedFrame
from rig_protocol.messages import Hello, Welcome

_log = logging.getLogger(__name__)

# How often the name of a server that does not answer is looked up again: its address may have changed.
_REOPEN_NS = 5_000_000_000
_NO_NETWORK_RETRY_NS = 1_000_000_000
_ONE_FRAME_NS = 33_333_333


class Uplink:
    """Sends frames to one server whenever it listens. One thread; the caller gives the time."""

    def __init__(self, settings: AgentSettings) -> None:
        """Silent until `introduce`."""
        self._server = settings.server
        self._datagram_size = settings.datagram_size
        self._transport = Transport(settings.address)
        self._pacer = Pacer(_ONE_FRAME_NS, settings.pacing.spread, settings.pacing.burst)
        self._link: AgentLink | None = None
        self._reopen_ns = 0
        self._refusal = ""
        self.connections = 0
        self.unheard = 0

    @property
    def welcome(self) -> Welcome | None:
        """The server's choices while it listens, else None."""
        return None if self._link is None else self._link.session

    @property
    def sent(self) -> int:
        """Frames sent whole."""
        return self._pacer.counters.sent

    @property
    def dropped(self) -> int:
        """Frames given up for newer ones."""
        return self._pacer.counters.dropped

    @property
    def network_errors(self) -> int:
        """Sends that the network refused."""
        return self._transport.counters.network_errors

    def introduce(self, hello: Hello, now_ns: int) -> None:
        """Say hello as this camera from now on; a session of another camera ends."""
        self._say_goodbye(now_ns)
        self._pacer.interval_ns = round(1e9 / hello.fps)
        self._link = AgentLink(hello, self._datagram_size, nonce_source=lambda: secrets.randbits(64))

    def report_health(self, gauges: Mapping[str, float]) -> None:
        """What the next heartbeats tell the server."""
        if self._link is not None:
            self._link.report_health(gauges)

    def fileno(self) -> int | None:
        """For a selector; changes when the transport opens anew."""
        return self._transport.fileno()

    def send_frame(self, frame: EncodedFrame, now_ns: int) -> None:
        """Queue a frame for sending; dropped, and counted in `unheard`, while nobody listens."""
        batch = None if self._link is None else self._link.send_frame(frame, now_ns)
        if batch is None:
            self.unheard += 1
        else:
            self._pacer.submit(batch, now_ns)

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
        if not self._link.connected and now_ns >= self._reopen_ns:
            self._reopen_ns = now_ns + (_REOPEN_NS if self._transport.open() else _NO_NETWORK_RETRY_NS)
        for datagram in self._link.datagrams_to_send(now_ns):
            self._transport.send_datagram(datagram)
        burst = self._pacer.next_burst(now_ns)
        if burst is not None:
            self._pacer.sent(self._transport.send(burst), now_ns)

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

    def _say_goodbye(self, now_ns: int) -> None:
        self._pacer.clear()
        if self._link is None:
            return
        self._link.close(now_ns)
        for datagram in self._link.datagrams_to_send(now_ns):
            self._transport.send_datagram(datagram)
        self._link = None

    def _report(self, event: AgentEvent) -> None:
        """Tell the operator what has changed; a refusal that repeats is told once."""
        match event:
            case Connected(welcome):
                self.connections += 1
                self._refusal = ""
                self._transport.server_reached()
                _log.info("connected to %s as camera %d", self._server, welcome.camera_id)
            case Rejected(reason, text):
                if text != self._refusal:
                    _log.error("%s refuses this camera (%s): %s; trying on", self._server, reason.name, text)
                self._refusal = text
            case Disconnected(text):
                self._pacer.clear()
                _log.warning("lost %s: %s; trying on", self._server, text)
