"""How the agent is doing: totals of every stage, gauges for the server, a line for the log now and then."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from rig_protocol.recorder import RecordingStatus

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
    recording: RecordingStatus | None = None
    """The take on this machine; None where nobody records."""


def gauges(totals: Totals) -> dict[str, float]:
    """What the server's operator may want to see of this agent, by name."""
    found: dict[str, float] = {
        "dropped": totals.dropped,
        "resent": totals.resent,
        "damaged": totals.damaged,
        "source_losses": totals.source_losses,
        **_recording_gauges(totals.recording),
        **{f"source_{name}": count for name, count in totals.source.items()},
    }
    try:
        found["temperature_c"] = int(_PROCESSOR_TEMPERATURE.read_text()) / 1000
    except (OSError, ValueError):
        return found  # this machine does not tell
    return found


def _recording_gauges(recording: RecordingStatus | None) -> dict[str, float]:
    """`recording`: 1 while a take is written, 0 when it has ended by itself."""
    if recording is None:
        return {}
    return {
        "recording": float(recording.ended is None),
        "recorded_bytes": recording.bytes,
        "not_recorded": recording.dropped,
    }


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
            f"{_recording_words(totals.recording)}"
        )


def _recording_words(recording: RecordingStatus | None) -> str:
    if recording is None:
        return ""
    ended = "" if recording.ended is None else f" before it ended: {recording.ended}"
    megabytes = recording.bytes / 1e6
    return f"; recorded {recording.frames} ({megabytes:.0f} MB), {recording.dropped} not recorded{ended}"
