"""Tells overload from other losses: most cameras lose frames, go on so, and lose fewer when less is sent."""

from collections.abc import Mapping

_BIN_NS = 500_000_000
_LOSSY = 0.05  # share of frames; resends leave far less of what a healthy network drops
# Where fewer than half of the frames are lost, sending less must lose less; else overload is not the cause.
# Where more are lost, a link that is several times too small loses as many as before.
_MODERATE = 0.5
_RELIEF = 0.7


class LossWatch:
    """Compares counts of received and lost frames, bin by bin.

    One lossy bin is an outage that is over, as when a cable is back and the gap shows at once. Two are not.
    """

    def __init__(self) -> None:
        self._bin_ns: int | None = None
        self._received: Mapping[int, int] = {}  # by camera id, when the bin began
        self._lost: Mapping[int, int] = {}
        self._lossy_bins = 0
        self._answered_share: float | None = None
        self._answer_failed = False
        self.share = 0.0

    @property
    def overloaded(self) -> bool:
        """True while most cameras lose frames, and sending less may help."""
        return self._lossy_bins >= 2 and not self._answer_failed

    def answered(self) -> None:
        """Less is sent from now on: see whether that helps."""
        self._answered_share = self.share if self._lossy_bins else None
        self._lossy_bins = 0

    def update(self, received: Mapping[int, int], lost: Mapping[int, int], now_ns: int) -> None:
        """Take the counts since the start by camera id; those of a camera that has left are left out."""
        if self._bin_ns is not None and 0 <= now_ns - self._bin_ns < _BIN_NS:
            return
        if self._bin_ns is not None:
            self._close_bin(_gain(self._received, received), _gain(self._lost, lost))
        self._bin_ns, self._received, self._lost = now_ns, dict(received), dict(lost)

    def _close_bin(self, came: list[int], gone: list[int]) -> None:
        total = sum(came) + sum(gone)
        self.share = sum(gone) / total if total else 0.0
        losing = sum(count > 0 for count in gone)
        if self.share < _LOSSY or 2 * losing <= len(gone):
            self._lossy_bins, self._answered_share, self._answer_failed = 0, None, False
            return
        self._lossy_bins += 1
        before = self._answered_share
        if self._lossy_bins >= 2 and before is not None and _RELIEF * before < self.share < _MODERATE:
            self._answer_failed = True


def _gain(before: Mapping[int, int], after: Mapping[int, int]) -> list[int]:
    """By how much each count has grown; one that is new or began anew has not."""
    return [max(0, count - before.get(camera_id, count)) for camera_id, count in after.items()]
