"""When a step down is due, and when one up: fast down, slow up, slower after each step up that failed."""

_SECOND_NS = 1_000_000_000
_OVERLOAD_NS = _SECOND_NS // 2  # sizes are means over a quarter of a second: down within one second in all
# A step up that lasted less has failed; the next one waits twice as long as the last.
_FIRST_HOLD_OFF_NS = 60 * _SECOND_NS
_LONGEST_HOLD_OFF_NS = 3600 * _SECOND_NS


class StepPatience:
    """Remembers since when there was overload or room, and what became of the last step up."""

    def __init__(self, step_up_s: float) -> None:
        """`step_up_s`: how long there must have been room for a step up."""
        self._room_ns = round(step_up_s * _SECOND_NS)
        self.begin()

    def begin(self) -> None:
        """A rig has come together: what an earlier one did says nothing about it."""
        self._overload_since_ns: int | None = None
        self._room_since_ns: int | None = None
        self._stepped_up_ns: int | None = None
        self._hold_off_ns = 0
        self._hold_until_ns = 0

    def too_long_over(self, overload: bool, now_ns: int) -> bool:
        """Take whether there is overload; True when it has lasted."""
        if not overload:
            self._overload_since_ns = None
            return False
        self._room_since_ns = None
        if self._overload_since_ns is None:
            self._overload_since_ns = now_ns
        return now_ns - self._overload_since_ns >= _OVERLOAD_NS

    def long_enough_under(self, room: bool, now_ns: int) -> bool:
        """Take whether there is room for more; True when a step up is due."""
        if not room:
            self._room_since_ns = None
            return False
        if self._room_since_ns is None:
            self._room_since_ns = now_ns
        return now_ns - self._room_since_ns >= self._room_ns and now_ns >= self._hold_until_ns

    def stepped_up(self, now_ns: int) -> None:
        """More is sent from now on."""
        self._room_since_ns, self._stepped_up_ns = None, now_ns

    def overload_ended_step(self, now_ns: int) -> None:
        """Less is sent from now on: the last step up did not last, or did for some time."""
        since_ns, self._stepped_up_ns = self._stepped_up_ns, None
        self._overload_since_ns = self._room_since_ns = None
        if since_ns is None:
            return
        if now_ns - since_ns < max(_FIRST_HOLD_OFF_NS, self._hold_off_ns):
            self._hold_off_ns = min(max(2 * self._hold_off_ns, _FIRST_HOLD_OFF_NS), _LONGEST_HOLD_OFF_NS)
        else:
            self._hold_off_ns //= 2
        self._hold_until_ns = now_ns + self._hold_off_ns
