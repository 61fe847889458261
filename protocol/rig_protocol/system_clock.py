"""This machine's wall clock, and how good whoever disciplines it (chrony, ntpd, PTP) says that it is.

For the shells of agent and server, like programs.py: it asks the kernel. The clocks are arguments.
"""

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

NanosecondClock = Callable[[], int]

_TRIES = 5
_TIME_ERROR = 5
_STA_UNSYNC = 0x0040
# The kernel's value where no daemon has stated one: 16 s (NTP_PHASE_LIMIT).
_NOT_STATED_US = 16_000_000
# The kernel lets maxerror grow by 500 ppm, in steps of a second.
_GROWTH_US_PER_S = 500
# Between two updates a disciplined clock wanders by less, with the temperature.
_WANDER = 1e-6
# linuxptp states no error but resets maxerror to 0 at each update, every second. Software stamps on a
# quiet network are good for some tens of microseconds, hardware stamps for less.
_PTP_ERROR_NS = 50_000
_PTP_MAX_US = 2 * _GROWTH_US_PER_S
_PTP_SEEN_NS = 5_000_000_000
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_C_LIBRARY = ctypes.CDLL(None)


class KernelClock(NamedTuple):
    """What adjtimex(2) says of the wall clock."""

    synchronised: bool
    max_error_us: int
    estimated_error_us: int


@dataclass(frozen=True, slots=True)
class SystemClockReading:
    """Wall clock minus monotonic clock; `error_ns` is the wall clock's standard uncertainty, None: unknown.

    The difference stands still while a daemon slews, because Linux slews both clocks alike.
    """

    wall_minus_monotonic_ns: int
    error_ns: int | None


class SystemClock:
    """Reads the wall clock against the monotonic one, and follows what its daemon states.

    chrony and ntpd state a standard deviation (`esterror`) and a bound (`maxerror`, with half the root
    delay: the asymmetry of the way to the source). The first alone is too good, and the second grows by
    500 ppm until the next update. So the bound counts as it was stated at the latest update that was seen.
    A stated error of zero (systemd-timesyncd) is no measurement, and counts as unknown. chrony tells the
    kernel that the clock is synchronised only where its configuration says `rtcsync`.
    """

    def __init__(
        self,
        monotonic_ns: NanosecondClock,
        wall_ns: NanosecondClock,
        kernel: Callable[[], KernelClock] | None = None,
    ) -> None:
        """`monotonic_ns` is the clock that stamps frames: agent time or rig time."""
        self._monotonic_ns, self._wall_ns = monotonic_ns, wall_ns
        self._kernel = kernel or kernel_clock
        self._last: tuple[int, int] | None = None  # when, and the maxerror read then
        self._stated: tuple[int, int] = (0, 0)  # the same of the latest update
        self._fresh_since_ns: int | None = None

    def read(self) -> SystemClockReading:
        """The difference of the two clocks, and its uncertainty; takes some microseconds."""
        reads = [(self._monotonic_ns(), self._wall_ns(), self._monotonic_ns()) for _ in range(_TRIES)]
        before_ns, wall_ns, after_ns = min(reads, key=lambda read: read[2] - read[0])
        error_ns = self._error_ns(self._kernel(), after_ns)
        if error_ns is not None:
            error_ns += (after_ns - before_ns + 1) // 2
        return SystemClockReading(wall_ns - (before_ns + after_ns) // 2, error_ns)

    def _error_ns(self, kernel: KernelClock, now_ns: int) -> int | None:
        if not kernel.synchronised:
            self._last = self._fresh_since_ns = None
            return None
        self._follow(kernel.max_error_us, now_ns)
        if 0 < kernel.estimated_error_us < _NOT_STATED_US:
            stated_ns, bound_us = self._stated
            wander_ns = _WANDER * (now_ns - stated_ns)
            return math.ceil(
                math.hypot(kernel.estimated_error_us * 1e3, bound_us * 1e3 / math.sqrt(3), wander_ns)
            )
        since_ns = self._fresh_since_ns
        return None if since_ns is None or now_ns - since_ns < _PTP_SEEN_NS else _PTP_ERROR_NS

    def _follow(self, max_error_us: int, now_ns: int) -> None:
        """Notice an update: the bound fell, or it rose by more than the kernel lets it grow."""
        if self._last is not None:
            last_ns, last_us = self._last
            grown_us = last_us + _GROWTH_US_PER_S * (1 + (now_ns - last_ns) / 1e9)
        if self._last is None or not last_us <= max_error_us <= grown_us:
            self._stated = (now_ns, max_error_us)
        self._last = (now_ns, max_error_us)
        if max_error_us > _PTP_MAX_US:
            self._fresh_since_ns = None
        elif self._fresh_since_ns is None:
            self._fresh_since_ns = now_ns


def boot_clock_name() -> str | None:
    """A name for this machine's monotonic clock since it was booted; None where the kernel tells none."""
    try:
        boot_id = _BOOT_ID.read_text().replace("-", "").strip()
    except OSError:
        return None
    return f"rig:{boot_id[:16]}" if boot_id[:16].isalnum() else None


class _Timex(ctypes.Structure):
    """struct timex of adjtimex(2), as far as it is read; the rest is room."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_long * 32),
    )


def kernel_clock() -> KernelClock:
    """Ask the kernel; unsynchronised where it has no adjtimex (no Linux) or refuses."""
    state = _Timex(maxerror=_NOT_STATED_US, esterror=_NOT_STATED_US)  # modes 0: change nothing
    adjtimex = getattr(_C_LIBRARY, "adjtimex", None)
    result = _TIME_ERROR if adjtimex is None else adjtimex(ctypes.byref(state))
    synchronised = 0 <= result < _TIME_ERROR and not state.status & _STA_UNSYNC
    return KernelClock(synchronised, state.maxerror, state.esterror)
