"""How often something may happen, by key, in bounded memory."""

from collections import OrderedDict
from collections.abc import Hashable


class RateLimit:
    """Allows one event an interval and key, and up to `burst` at once that were saved up before.

    Remembers the latest `max_keys` keys.
    """

    def __init__(self, interval_ns: int, max_keys: int = 256, burst: int = 1) -> None:
        self._interval_ns = interval_ns
        self._max_keys = max_keys
        self._saved_ns = (burst - 1) * interval_ns
        self._full_ns: OrderedDict[Hashable, int] = OrderedDict()  # when all that was used is saved up again

    def allows(self, key: Hashable, now_ns: int) -> bool:
        """True, and remembered, when an event of this key may happen now."""
        full_ns = max(self._full_ns.get(key, now_ns), now_ns)
        if full_ns - now_ns > self._saved_ns + self._interval_ns:
            full_ns = now_ns  # the clock was set back
        if full_ns - now_ns > self._saved_ns:
            return False
        self._full_ns[key] = full_ns + self._interval_ns
        self._full_ns.move_to_end(key)
        if len(self._full_ns) > self._max_keys:
            self._full_ns.popitem(last=False)
        return True
