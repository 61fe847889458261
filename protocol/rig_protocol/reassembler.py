"""Fragments of one session back into frames: any order, bounded, every loss counted by its cause.

Rules and numbers: protocol/SPEC.md, section 7.
"""

from typing import NamedTuple

import numpy as np

from rig_protocol.counters import CameraCounters
from rig_protocol.datagram import FRAGMENT_HEADER_SIZE, Buffer, FragmentHeader
from rig_protocol.errors import DataError
from rig_protocol.frame_unit import FRAME_HEADER_SIZE, MAX_UNIT_SIZE, frame_crc, parse_unit
from rig_protocol.frames import EncodedFrame

# 200 ms of reordering at 30 frames/s is 6 frames; 8 bound the memory at 16 MiB a camera.
MAX_OPEN_UNITS = 8
# One second at 30 frames/s: outlasts every open unit.
NUMBER_WINDOW = 32
# A paced frame takes up to one frame interval; the rest is the network's.
GRACE_NS = 200_000_000

# A verified number moves the window; until one comes, losses are remembered for as many frames: 34 s.
_MAX_FATES = 1024
# Late fragments follow soon after their unit was given up.
_MAX_LOST_KEYS = 64
_MAX_FRAGMENTS = 2**16


class _UnitKey(NamedTuple):
    """What all fragments of one unit agree on, within one session."""

    frame_number: int
    frame_crc: int
    unit_size: int
    payload_size: int


class _OpenUnit:
    """A unit that still lacks fragments."""

    __slots__ = ("content", "deadline_ns", "missing", "received")

    def __init__(self, header: FragmentHeader, deadline_ns: int) -> None:
        self.deadline_ns = deadline_ns
        self.content = bytearray(header.unit_size)
        self.missing = header.fragment_count
        self.received = bytearray(self.missing)  # one byte a fragment, 1 = held


class Reassembler:
    """Reassembles the frames of one session; counts into `counters`."""

    def __init__(self, camera_id: int, fps: float, counters: CameraCounters) -> None:
        self._camera_id = camera_id
        self._timeout_ns = round(1e9 / fps) + GRACE_NS
        self._counters = counters
        self._open: dict[_UnitKey, _OpenUnit] = {}  # oldest first
        self._lost_keys: dict[_UnitKey, None] = {}  # oldest first
        self._window_start = 0
        self._fates: dict[int, bool] = {}  # by frame number, from the window's start: True = delivered

    @property
    def next_deadline_ns(self) -> int | None:
        """When `expire` has something to do next."""
        return next((unit.deadline_ns for unit in self._open.values()), None)

    def receive(self, first: FragmentHeader, run: Buffer, count: int, now_ns: int) -> EncodedFrame | None:
        """Take `count` equal-sized datagrams laid back to back; the frame, in agent time, when one is whole.

        `first` is the header of the first of them; the others are known to continue it.
        """
        size = len(run) // count - FRAGMENT_HEADER_SIZE
        fits = _fits(first, count, size)
        if count > 1 and not fits:
            return self._receive_singly(first, run, count, now_ns)
        if not fits:
            self._counters.bad_fragment += 1
            return None
        key = _UnitKey(first.frame_number, first.frame_crc, first.unit_size, first.payload_size)
        unit = self._open.get(key) or self._open_unit(key, first, count, now_ns)
        if unit is None:
            return None
        start, stop = first.fragment_index, first.fragment_index + count
        held = unit.received.count(1, start, stop)
        if count > 1 and held:
            return self._receive_singly(first, run, count, now_ns)
        if held:
            self._counters.duplicate += 1
            return None
        _copy(run, count, unit.content, start * first.payload_size, size)
        unit.received[start:stop] = b"\x01" * count
        unit.missing -= count
        self._counters.fragments += count
        return None if unit.missing else self._complete(key, first, unit)

    def expire(self, now_ns: int) -> None:
        """Give up the units whose time is over."""
        while self._open:
            key, unit = next(iter(self._open.items()))
            if unit.deadline_ns > now_ns:
                return
            self._counters.incomplete += 1
            self._give_up(key)

    def close(self) -> None:
        """The session is over: what is not whole, or was never seen below a delivered number, is lost."""
        delivered = [number for number, whole in self._fates.items() if whole]
        self._move_window(max(delivered, default=-1) + 1)
        for key in list(self._open):
            self._counters.incomplete += 1
            self._give_up(key)

    def _receive_singly(
        self, first: FragmentHeader, run: Buffer, count: int, now_ns: int
    ) -> EncodedFrame | None:
        """The slow path for a run of which some fragments are held already or do not fit."""
        frame = None
        size = len(run) // count
        for k in range(count):
            header = first._replace(fragment_index=(first.fragment_index + k) % _MAX_FRAGMENTS)
            frame = self.receive(header, run[k * size : (k + 1) * size], 1, now_ns) or frame
        return frame

    def _open_unit(self, key: _UnitKey, header: FragmentHeader, count: int, now_ns: int) -> _OpenUnit | None:
        """A new unit, or None (counted) where the number is over or the header out of bounds."""
        counters, number = self._counters, key.frame_number
        if number < self._window_start or key in self._lost_keys:
            counters.late += count
        elif self._fates.get(number):
            counters.duplicate += count
        elif key.unit_size > MAX_UNIT_SIZE:
            counters.oversized += count
        elif key.unit_size < FRAME_HEADER_SIZE or header.fragment_count > _MAX_FRAGMENTS:
            counters.bad_fragment += count
        else:
            if len(self._open) == MAX_OPEN_UNITS:
                counters.evicted += 1
                self._give_up(next(iter(self._open)))
            self._open[key] = unit = _OpenUnit(header, now_ns + self._timeout_ns)
            return unit
        return None

    def _complete(self, key: _UnitKey, header: FragmentHeader, unit: _OpenUnit) -> EncodedFrame | None:
        try:
            if frame_crc(unit.content, header) != key.frame_crc:
                raise DataError("the crc does not hold")
            frame = parse_unit(unit.content, self._camera_id)
        except DataError:
            self._counters.corrupt += 1
            self._give_up(key)
            return None
        # What a bit error made of a header of this frame goes with it.
        for other in [k for k in self._open if k.frame_number == key.frame_number]:
            del self._open[other]
        self._fates[key.frame_number] = True
        self._move_window(key.frame_number - NUMBER_WINDOW + 1)
        return frame

    def _move_window(self, start: int) -> None:
        """Close the numbers below `start`; those without a fate were never seen."""
        if start <= self._window_start:
            return
        for key in [k for k in self._open if k.frame_number < start]:
            self._counters.incomplete += 1
            self._give_up(key)
        known = [number for number in self._fates if number < start]
        self._counters.missing += start - self._window_start - len(known)
        for number in known:
            del self._fates[number]
        self._window_start = start

    def _give_up(self, key: _UnitKey) -> None:
        """Close a unit whose loss its caller has counted."""
        del self._open[key]
        self._lost_keys[key] = None
        if len(self._lost_keys) > _MAX_LOST_KEYS:
            del self._lost_keys[next(iter(self._lost_keys))]
        self._fates.setdefault(key.frame_number, False)
        if len(self._fates) > _MAX_FATES:
            del self._fates[next(iter(self._fates))]


def _fits(first: FragmentHeader, count: int, size: int) -> bool:
    """True when `count` fragments of `size` payload bytes lie in the unit as SPEC section 3 cuts it."""
    last = (first.unit_size - 1) // first.payload_size
    stop = first.fragment_index + count
    if stop <= last:
        return size == first.payload_size
    last_size = first.unit_size - last * first.payload_size
    return stop == last + 1 and size == last_size and (count == 1 or size == first.payload_size)


def _copy(run: Buffer, count: int, content: bytearray, offset: int, size: int) -> None:
    """Payloads of a run into their place: one strided copy."""
    if count == 1:
        content[offset : offset + size] = memoryview(run)[FRAGMENT_HEADER_SIZE:]
        return
    rows = np.frombuffer(run, dtype=np.uint8).reshape(count, FRAGMENT_HEADER_SIZE + size)
    place = np.frombuffer(content, dtype=np.uint8, count=count * size, offset=offset).reshape(count, size)
    place[:] = rows[:, FRAGMENT_HEADER_SIZE:]
