"""A Kinect's clock against this machine's: device ticks become agent time."""

from collections import deque

TICK_HZ = 60_000_000
_WRAP = 1 << 32  # ticks are a uint32: 71.58 s
_WINDOW_NS = 3_000_000_000
# One isochronous transfer holds 16 microframes of 125 µs: a frame arrives up to this late, evenly spread.
_TRANSFER_NS = 2_000_000
_DRIFT = 100e-6  # quartz clocks differ by less


def tick_difference(later: int, earlier: int) -> int:
    """Ticks from `earlier` to `later`, signed, across the counter's wrap."""
    return (later - earlier + _WRAP // 2) % _WRAP - _WRAP // 2


class DeviceClock:
    """Unwraps ticks and maps them to agent time by the least delayed frame of the last seconds.

    Delays between the sensor and this program only ever add, so the smallest observed lag is the best
    estimate of the clocks' offset (the minimum filter of clock exchange protocols).
    """

    def __init__(self) -> None:
        """Start with no idea of the offset."""
        self._last: tuple[int, int] | None = None
        self._lags: deque[tuple[int, int]] = deque()

    def stamp(self, ticks: int, arrival_ns: int) -> tuple[int, int]:
        """Agent time of this tick count, and its uncertainty, both in ns."""
        device_ns = self._unwrap(ticks, arrival_ns) * 1_000_000_000 // TICK_HZ
        self._lags.append((arrival_ns, arrival_ns - device_ns))
        while arrival_ns - self._lags[0][0] > _WINDOW_NS:
            self._lags.popleft()
        lags = sorted(lag for _, lag in self._lags)
        offset_ns = lags[0]
        # The least of n evenly spread delays is expected at 1/(n+1) of their range, which is twice the
        # distance to their median; a busy machine delays more than the transfer does.
        range_ns = max(_TRANSFER_NS, 2 * (lags[len(lags) // 2] - offset_ns))
        drift_ns = round(_DRIFT * (arrival_ns - self._lags[0][0]))
        return device_ns + offset_ns, range_ns // (len(lags) + 1) + drift_ns

    def _unwrap(self, ticks: int, arrival_ns: int) -> int:
        """Ticks since the first wrap, however long nothing arrived."""
        total = ticks
        if self._last is not None:
            last_total, last_arrival_ns = self._last
            expected = last_total + (arrival_ns - last_arrival_ns) * TICK_HZ // 1_000_000_000
            total = expected + tick_difference(ticks, expected)
        self._last = (total, arrival_ns)
        return total
