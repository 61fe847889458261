"""Who is here, and who was: the sessions of one server by id, and what it knows of every camera."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType

from rig_protocol.admission import same_agent
from rig_protocol.events import Address
from rig_protocol.messages import Hello
from rig_protocol.pending_sessions import PendingSession
from rig_protocol.resend_budget import ResendBudget
from rig_protocol.server_session import CameraStatus, ServerSession


class SessionTable:
    """At most one session a camera; statuses outlive sessions. The roster bounds the cameras."""

    def __init__(self, resend_budget: ResendBudget) -> None:
        """All sessions share the budget."""
        self._resend_budget = resend_budget
        self._sessions: dict[int, ServerSession] = {}  # by session id
        self._statuses: dict[int, CameraStatus] = {}  # by camera id

    def __contains__(self, session_id: int) -> bool:
        return session_id in self._sessions

    def __iter__(self) -> Iterator[ServerSession]:
        """Those of now: sessions may begin and end meanwhile."""
        return iter(list(self._sessions.values()))

    @property
    def statuses(self) -> Mapping[int, CameraStatus]:
        """Every camera that was here since the start, by id; a live view."""
        return MappingProxyType(self._statuses)

    def of_id(self, session_id: int) -> ServerSession | None:
        """The session of that id."""
        return self._sessions.get(session_id)

    def of_camera(self, camera_id: int) -> ServerSession | None:
        """The session that holds a slot."""
        return next((s for s in self._sessions.values() if s.welcome.camera_id == camera_id), None)

    def recall(self, hello: Hello, address: Address) -> int | None:
        """The id that this camera had before."""
        same = (i for i, status in self._statuses.items() if same_agent(status, hello, address))
        return next(same, None)

    def taken(self, hello: Hello, address: Address) -> set[int]:
        """Ids that other live cameras hold."""
        others = (s for s in self._sessions.values() if not same_agent(s.status, hello, address))
        return {session.welcome.camera_id for session in others}

    def begin(self, pending: PendingSession, now_ns: int) -> None:
        """The agent of an answered hello has proved to be there."""
        welcome, hello, address = pending.agreement.welcome, pending.hello, pending.address
        status = self._statuses.get(welcome.camera_id)
        if status is None:
            status = CameraStatus(welcome.camera_id, hello.name, address, hello)
            self._statuses[welcome.camera_id] = status
        status.joined(hello, address)
        self._sessions[welcome.session_id] = ServerSession(
            status, pending.agreement, self._resend_budget, now_ns
        )

    def end(self, session: ServerSession) -> None:
        """Close a session; what it leaves unfinished is counted."""
        del self._sessions[session.welcome.session_id]
        session.close()
