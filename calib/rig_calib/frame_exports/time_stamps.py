"""The times of a capture as other programs expect them: Unix time, where the capture tells the date."""

from dataclasses import dataclass
from typing import Self

from rig_calib.offline.capture import Capture
from rig_calib.recorded_panoramas import is_recording
from rig_protocol.recording import Recording

_RIG_TIME = "time stamps are rig time: {} does not tell its date"


@dataclass(frozen=True, slots=True)
class TimeStamps:
    """`utc_minus_rig_ns`: what makes Unix time of rig time, to a second; None where nobody knows."""

    utc_minus_rig_ns: int | None
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, capture: Capture) -> Self:
        """Those of a capture; a rig folder has none, and its frames are stamped as at 30 Hz."""
        known = Recording(capture.path).utc_minus_rig_time_ns if is_recording(capture.path) else None
        return cls(known, () if known is not None else (_RIG_TIME.format(capture.path),))

    def ns(self, rig_time_ns: int) -> int:
        """Nanoseconds of Unix time, or of rig time."""
        return rig_time_ns + (self.utc_minus_rig_ns or 0)

    def seconds(self, rig_time_ns: int) -> str:
        """Seconds to the microsecond, in figures."""
        seconds, microseconds = divmod(self.ns(rig_time_ns) // 1000, 1_000_000)
        return f"{seconds}.{microseconds:06d}"
