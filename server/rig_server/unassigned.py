"""Agents that hold the rig's key and have no slot: remembered, so that somebody can give them one."""

from collections.abc import Collection
from dataclasses import dataclass

from rig_protocol.events import HelloRefused
from rig_protocol.messages import RejectReason
from rig_protocol.roster import known_serial

# Twice a ring; an agent that is refused says hello every few seconds, so these are of the last minutes.
MAX_UNASSIGNED = 32
# An agent tries again after 5 s at the latest; refusals of a whole ring are told five a second.
_HERE_NS = 30_000_000_000


@dataclass(frozen=True, slots=True)
class UnassignedAgent:
    """Who was refused for want of a slot; `camera_id` is the slot it wanted, None where it named none."""

    name: str
    host: str
    serial: str | None
    port_path: str | None
    camera_id: int | None

    def __str__(self) -> str:
        """For people: "pi-7 (serial A00366A1, at 10.0.0.7)"."""
        known = [
            None if self.serial is None else f"serial {self.serial}",
            None if self.port_path is None else f"port {self.port_path}",
            f"at {self.host}",
        ]
        return f"{self.name} ({', '.join(word for word in known if word)})"


class UnassignedAgents:
    """The latest of them; one thread at a time."""

    def __init__(self) -> None:
        self._seen_ns: dict[UnassignedAgent, int] = {}  # oldest first

    def take(self, event: HelloRefused, now_ns: int) -> None:
        """Note a refusal where it is about the slot."""
        hello = event.hello
        if event.reason is not RejectReason.UNKNOWN_CAMERA or hello is None:
            return
        agent = UnassignedAgent(
            hello.name, event.address[0], known_serial(hello), hello.port_path, hello.camera_id
        )
        self._seen_ns.pop(agent, None)
        self._seen_ns[agent] = now_ns
        if len(self._seen_ns) > MAX_UNASSIGNED:
            del self._seen_ns[next(iter(self._seen_ns))]

    def here(self, now_ns: int) -> tuple[UnassignedAgent, ...]:
        """Those that have said hello lately, by name."""
        here = (agent for agent, seen_ns in self._seen_ns.items() if now_ns - seen_ns <= _HERE_NS)
        return tuple(sorted(here, key=lambda agent: (agent.name, agent.host)))

    def forget(self, serials: Collection[str | None]) -> None:
        """These have been given a slot."""
        for agent in [one for one in self._seen_ns if one.serial is not None and one.serial in serials]:
            del self._seen_ns[agent]
