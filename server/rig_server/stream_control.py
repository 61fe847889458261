"""The link budget at work: what the planner decides goes to the agents, what it noticed to the log."""

import logging

from rig_protocol.events import CameraJoined, CameraLeft, FrameReceived, ServerEvent
from rig_protocol.messages import StreamChoice
from rig_protocol.server_link import ServerLink
from rig_protocol.troubleshooting import Topic, see
from rig_server.stream_planner import Refusal, StreamPlanner

logger = logging.getLogger(__name__)

_UPDATE_INTERVAL_NS = 250_000_000


class StreamControl:
    """Between link and planner, on the receiver's thread."""

    def __init__(self, link: ServerLink, planner: StreamPlanner) -> None:
        self._link, self._planner = link, planner
        self._told: dict[int, StreamChoice] = {}
        self._due_ns = 0

    @property
    def summary(self) -> str | None:
        """One sentence on what is sent now and what that takes; None while nothing is."""
        return self._planner.summary if self._planner.choices else None

    def take(self, event: ServerEvent, now_ns: int) -> None:
        """Note what the link tells."""
        match event:
            case FrameReceived(frame):
                self._planner.frame_received(frame)
            case CameraJoined(camera_id, hello, address):
                answer = self._planner.camera_joined(camera_id, hello, address, now_ns)
                if isinstance(answer, Refusal):  # two came at once, and there is room for one
                    self._link.dismiss(camera_id, answer.text)
                self._told.pop(camera_id, None)  # a new session knows no plan
                self._tell()
            case CameraLeft(camera_id):
                self._planner.camera_left(camera_id, now_ns)
                self._told.pop(camera_id, None)
                self._tell()
            case _:
                return

    def turn(self, now_ns: int) -> None:
        """Look at the load a few times a second; called often."""
        if now_ns >= self._due_ns or self._due_ns - now_ns > 2 * _UPDATE_INTERVAL_NS:
            self._due_ns = now_ns + _UPDATE_INTERVAL_NS
            lost = {camera_id: status.counters.lost for camera_id, status in self._link.cameras.items()}
            self._planner.update(now_ns, lost)
            self._tell()

    def _tell(self) -> None:
        self._link.limit_resends(self._planner.spare_bytes_s)
        for camera_id, choice in self._planner.choices.items():
            if self._told.get(camera_id) != choice:
                self._told[camera_id] = choice
                self._link.plan_stream(camera_id, choice)
        for note in self._planner.take_notes():
            extra = see(Topic.LOW_RATE) if note.severity >= logging.WARNING else None
            logger.log(note.severity, "%s", note.text, extra=extra)
