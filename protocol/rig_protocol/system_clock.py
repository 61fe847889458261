"""What this machine's system clock is worth."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SystemClockReading:
    """The system clock against the monotonic one, and its standard error (None: undisciplined)."""

    wall_minus_monotonic_ns: int
    error_ns: int | None
