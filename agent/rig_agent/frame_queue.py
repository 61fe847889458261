"""A bounded queue between two threads whose producer never waits."""

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class FrameQueue(Generic[T]):
    """Keeps the newest `capacity` items; putting one more drops the oldest and counts it."""

    def __init__(self, capacity: int) -> None:
        """An empty queue."""
        self._items: deque[T] = deque(maxlen=capacity)
        self._changed = threading.Condition()
        self.dropped = 0

    def put(self, item: T) -> T | None:
        """Add the newest item, at once; the one that it drops for it."""
        with self._changed:
            dropped = self._items[0] if len(self._items) == self._items.maxlen else None
            self.dropped += dropped is not None
            self._items.append(item)
            self._changed.notify()
            return dropped

    def get(self, timeout_s: float = 0.0) -> T | None:
        """Take the oldest item, or None when none came in time."""
        with self._changed:
            if not self._items and timeout_s > 0:
                self._changed.wait(timeout_s)
            return self._items.popleft() if self._items else None
