"""The pace of a replay."""

import time


class Pace:
    """When what was recorded at some time is due."""

    def __init__(self, speed: float | None) -> None:
        self._speed = speed
        self._begun: tuple[float, int] | None = None

    def restart(self, time_ns: int) -> None:
        """What was recorded at `time_ns` is due now."""
        self._begun = time.monotonic(), time_ns

    def wait(self, time_ns: int, timeout_s: float) -> bool:
        """Wait until it is due, but no longer than `timeout_s`; False when it is not due then."""
        if self._speed is None:
            return True
        now_s = time.monotonic()
        begun_s, begun_ns = self._begun = self._begun or (now_s, time_ns)
        wait_s = begun_s + (time_ns - begun_ns) / 1e9 / self._speed - now_s
        time.sleep(max(0.0, min(wait_s, timeout_s)))
        return wait_s <= timeout_s
