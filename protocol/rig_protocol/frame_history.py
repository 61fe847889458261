"""The agent's memory of what it sent, for the server to ask again, within a budget."""

from collections import deque
from collections.abc import Callable

from rig_protocol.datagram import DatagramBatch
from rig_protocol.messages import Resend

# 266 ms at 30 frames/s: as long as the server waits for a frame. At most 16 MiB, 1.6 MB of usual frames.
_MAX_FRAMES = 8
# Of the bytes of frames, so much may be sent again; a link that loses more needs another cure.
_SHARE = 0.25
# Saved up for a burst of losses: a whole cable's worth of one frame, twice.
_MAX_SAVED_FRAMES = 3


class FrameHistory:
    """The datagrams of the latest frames of one session."""

    def __init__(self) -> None:
        self._frames: deque[tuple[int, DatagramBatch]] = deque(maxlen=_MAX_FRAMES)
        self._credit_bytes = 0.0
        self.refused = 0  # fragments asked for that are no longer held, or over the budget

    def add(self, frame_number: int, batch: DatagramBatch) -> None:
        """Remember a frame; the oldest is forgotten for it."""
        size = batch.total_bytes
        if not self._frames:
            self._credit_bytes = float(size)
        self._frames.append((frame_number, batch))
        self._credit_bytes = min(self._credit_bytes + _SHARE * size, _MAX_SAVED_FRAMES * size)

    def forget(self, batch: DatagramBatch) -> None:
        """A frame that was given up before it was sent is not sent again either."""
        kept = [(number, held) for number, held in self._frames if held is not batch]
        self._frames = deque(kept, maxlen=_MAX_FRAMES)

    def find(self, frame_number: int) -> DatagramBatch | None:
        """A frame that is still held."""
        return next((batch for number, batch in self._frames if number == frame_number), None)

    def first_unsent(self, sent_of: Callable[[DatagramBatch], int]) -> int | None:
        """The oldest frame that has not left whole; None when all have."""
        return next((number for number, batch in self._frames if sent_of(batch) < len(batch)), None)

    def answer(self, resend: Resend, sent: int) -> list[DatagramBatch]:
        """What to send again of a frame of which the first `sent` datagrams have been sent at all."""
        batch = self.find(resend.frame_number)
        answers = []
        for first, count in resend.ranges:
            stop = min(first + count, sent)
            if batch is None:
                self.refused += count if count < 0xFFFF else 1
            elif first < stop:
                answers += self._within_budget(batch, first, stop)
        return answers

    def _within_budget(self, batch: DatagramBatch, first: int, stop: int) -> list[DatagramBatch]:
        affordable = int(self._credit_bytes // batch.segment_size)
        granted = min(stop - first, affordable)
        self.refused += stop - first - granted
        self._credit_bytes -= granted * batch.segment_size
        if not granted:
            return []
        return [DatagramBatch(batch.part(first, first + granted), batch.segment_size)]
