"""Events of the server's link until its owner fetches them, in order and bounded."""

from collections import deque

from rig_protocol.events import FrameReceived, ServerEvent

# Five whole sets of twelve: more means that nobody fetches.
MAX_FRAMES = 64
MAX_OTHERS = 256


class EventQueue:
    """Frames and other events have bounds of their own; the oldest goes when one is reached."""

    def __init__(self) -> None:
        self._frames: deque[tuple[int, FrameReceived]] = deque()
        self._others: deque[tuple[int, ServerEvent]] = deque()
        self._pushed = 0

    def push(self, event: ServerEvent) -> ServerEvent | None:
        """Append an event; what had to go for it, if anything."""
        self._pushed += 1
        if isinstance(event, FrameReceived):
            self._frames.append((self._pushed, event))
            return self._frames.popleft()[1] if len(self._frames) > MAX_FRAMES else None
        self._others.append((self._pushed, event))
        return self._others.popleft()[1] if len(self._others) > MAX_OTHERS else None

    def pop(self) -> ServerEvent | None:
        """The oldest event, or None."""
        frames, others = self._frames, self._others
        if frames and (not others or frames[0][0] < others[0][0]):
            return frames.popleft()[1]
        return others.popleft()[1] if others else None
