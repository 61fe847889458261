"""How the agent is doing: totals of every stage, gauges for the server, a line for the log now and then."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

_PROCESSOR_TEMPERATURE = Path("/sys/class/thermal/thermal_zone0/temp")  # in 1/1000 °C, on a Pi and most PCs


@dataclass(frozen=True, slots=True)
class Totals:
    """Counts since the start of the program."""

    captured: int = 0
    """Frames that the source delivered."""
    sent: int = 0
    """Frames whose every datagram was handed to the network."""
    dropped: int = 0
    """Frames given up for newer ones, before or after encoding, or while being sent."""
    resent: int = 0
    """Datagrams that the server missed and got again."""
    unheard: int = 0
    """Frames captured while no server listened."""
    damaged: int = 0
    """Frames that the source delivered with a part missing."""
    connections: int = 0
    """Sessions with the server."""
    source_losses: int = 0
    """Times that the device was lost or could not be opened."""
    network_errors: int = 0
    """Sends that the network refused."""
    source: Mapping[str, int] = field(default_factory=dict)
    """What the driver counted, by its own names; what is zero may be left out."""


def gauges(totals: Totals) -> dict[str, float]:
    """What the server's operator may want to see of this agent, by name."""
    found: dict[str, float] = {
        "dropped": totals.dropped,
        "resent": totals.resent,
        "damaged": totals.damaged,
        "source_losses": totals.source_losses,
        **{f"source_{name}": count for name, count in totals.source.items()},
    }
    try:
        found["temperature_c"] = int(_PROCESSOR_TEMPERATURE.read_text()) / 1000
    except (OSError, ValueError):
        return found  # this machine does not tell
    return found


class HealthLog:
    """Says when a line is due and what it says; rates are those since the line before."""

    def __init__(self, interval_s: float, now_ns: int) -> None:
        """The first line is due one interval from now."""
        self._interval_ns = round(interval_s * 1e9)
        self._since_ns = now_ns
        self._before = Totals()

    @property
    def interval_ns(self) -> int:
        """From one line to the next."""
        return self._interval_ns

    @property
    def due_ns(self) -> int:
        """When the next line is due."""
        return self._since_ns + self._interval_ns

    def line(self, totals: Totals, connected: bool, now_ns: int) -> str:
        """One line about the time since the last one."""
        seconds = max(now_ns - self._since_ns, 1) / 1e9
        captured, sent = totals.captured - self._before.captured, totals.sent - self._before.sent
        self._since_ns, self._before = now_ns, totals
        source = "".join(f", {count} {name} by the source" for name, count in totals.source.items())
        return (
            f"{'connected' if connected else 'not connected'}: "
            f"captured {captured / seconds:.1f} fps, sent {sent / seconds:.1f} fps; in total "
            f"{totals.sent} sent, {totals.dropped} dropped, {totals.unheard} unheard, "
            f"{totals.resent} resent, "
            f"{totals.damaged} damaged, {totals.connections} connections, "
            f"{totals.source_losses} device losses, {totals.network_errors} network errors{source}"
        )
