"""What happened to frames and datagrams, by name (protocol/SPEC.md, sections 7 and 9)."""

from collections import Counter
from dataclasses import dataclass, field


@dataclass(slots=True)
class CameraCounters:
    """Of one camera at the server, over all its sessions. Only ever counted up.

    Frames first: `frames` were delivered, of them `damaged` flagged so; the others were lost. Then fragments
    and control messages that were dropped.
    """

    sessions: int = 0
    bytes: int = 0
    fragments: int = 0
    frames: int = 0
    damaged: int = 0
    # frames lost
    missing: int = 0
    incomplete: int = 0
    evicted: int = 0
    corrupt: int = 0
    unexpected_codec: int = 0
    untimed: int = 0
    overflow: int = 0
    # fragments that were asked for again, and those of them that then came
    requested: int = 0
    resent: int = 0
    # datagrams dropped
    late: int = 0
    duplicate: int = 0
    oversized: int = 0
    bad_fragment: int = 0
    bad_clock_reply: int = 0
    # the agent's clock jumped; a disciplined system clock that the exchange disproves
    clock_steps: int = 0
    system_clock_disagreements: int = 0

    @property
    def lost(self) -> int:
        """Frames that the agent sent and nobody got."""
        return (
            self.missing
            + self.incomplete
            + self.evicted
            + self.corrupt
            + self.unexpected_codec
            + self.untimed
            + self.overflow
        )


@dataclass(slots=True)
class AgentCounters:
    """Of one agent's link. Only ever counted up."""

    hellos: int = 0
    sessions: int = 0
    rejects: int = 0
    # frames handed over, and those dropped: without a session, or encoded for another session's choice
    frames: int = 0
    fragments: int = 0
    bytes: int = 0
    not_connected: int = 0
    unexpected_codec: int = 0
    # fragments that the server asked for again: sent, and refused (no longer held, or over the budget)
    resent: int = 0
    resend_refused: int = 0
    # received datagrams that were dropped, by cause
    rejected: Counter[str] = field(default_factory=Counter)
