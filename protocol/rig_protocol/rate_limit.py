"""How often something may happen, by key, in bounded memory."""

from collections import OrderedDict
from collections.abc import Hashable


class RateLimit:
    """Allows one event an interval and key; remembers the latest `max_keys` keys."""

    def __init__(self, interval_ns: int, max_keys: int = 256) -> None:
        self._interval_ns = interval_ns
        self._max_keys = max_keys
        self._last_ns: OrderedDict[Hashable, int] = OrderedDict()

    def allows(self, key: Hashable, now_ns: int) -> bool:
        """True, and remembered, when the last allowed event of this key is an interval ago."""
        last_ns = self._last_ns.get(key)
        if last_ns is not None and now_ns - last_ns < self._interval_ns:
            return False
        self._last_ns[key] = now_ns
        self._last_ns.move_to_end(key)
        if len(self._last_ns) > self._max_keys:
            self._last_ns.popitem(last=False)
        return True


class TokenBucket:
    """Allows `burst` events at once, and one an interval in the long run."""

    def __init__(self, interval_ns: int, burst: int) -> None:
        self._interval_ns = interval_ns
        self._saved_ns = self._most_ns = interval_ns * burst
        self._last_ns: int | None = None

    def allows(self, now_ns: int) -> bool:
        """True, and spent, while something is saved."""
        elapsed_ns = 0 if self._last_ns is None else max(0, now_ns - self._last_ns)
        self._last_ns = now_ns
        self._saved_ns = min(self._saved_ns + elapsed_ns, self._most_ns)
        if self._saved_ns < self._interval_ns:
            return False
        self._saved_ns -= self._interval_ns
        return True
