"""How long something usually takes, and how long it may: smoothed mean and deviation (RFC 6298)."""


class SmoothedDelay:
    """Mean and mean deviation of observed delays; `bound_ns` is rarely exceeded."""

    def __init__(self, initial_ns: int, lowest_ns: int, highest_ns: int) -> None:
        """The bound is `initial_ns` before the first observation, and always in [lowest, highest]."""
        self._lowest_ns, self._highest_ns = lowest_ns, highest_ns
        self._mean_ns: float | None = None
        self._deviation_ns = 0.0
        self.bound_ns = initial_ns

    def add(self, delay_ns: int) -> None:
        """Take an observation."""
        if self._mean_ns is None:
            self._mean_ns, self._deviation_ns = float(delay_ns), delay_ns / 2
        else:
            error_ns = delay_ns - self._mean_ns
            self._deviation_ns += (abs(error_ns) - self._deviation_ns) / 4
            self._mean_ns += error_ns / 8
        bound_ns = round(self._mean_ns + 4 * self._deviation_ns)
        self.bound_ns = min(max(bound_ns, self._lowest_ns), self._highest_ns)
