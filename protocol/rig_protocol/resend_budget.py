"""How much may be asked for again: what the link has left beside the frames themselves.

On a full link every answer to a request pushes out a frame's own datagrams, which are then asked for in turn.
"""

# Saved up for a burst of losses: so much time of the spare rate.
_SAVED_NS = 100_000_000


class ResendBudget:
    """Of all cameras of one server together. Unlimited until `limit` says otherwise."""

    def __init__(self) -> None:
        self._bytes_per_s: float | None = None
        self._saved_bytes = 0.0
        self._last_ns: int | None = None

    def limit(self, bytes_per_s: float | None) -> None:
        """Spare rate of the link from now on; None: no limit."""
        self._bytes_per_s = bytes_per_s

    def grant(self, pieces: int, piece_bytes: int, now_ns: int) -> int:
        """How many of `pieces` may be asked for now; they are spent with that."""
        if self._bytes_per_s is None:
            return pieces
        elapsed_ns = 0 if self._last_ns is None else max(0, now_ns - self._last_ns)
        self._last_ns = now_ns
        # A piece larger than that, a whole frame, takes its time to save up.
        most_bytes = max(self._bytes_per_s * _SAVED_NS / 1e9, piece_bytes)
        self._saved_bytes = min(self._saved_bytes + self._bytes_per_s * elapsed_ns / 1e9, most_bytes)
        granted = min(pieces, int(self._saved_bytes // piece_bytes))
        self._saved_bytes -= granted * piece_bytes
        return granted
