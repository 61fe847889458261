"""Fragments of one session back into frames: any order, bounded, every loss counted by its cause.

Rules and numbers: protocol/SPEC.md, section 7.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from rig_protocol.counters import CameraCounters
from rig_protocol.datagram import FRAGMENT_HEADER_SIZE, MIN_DATAGRAM_SIZE, Buffer, FragmentHeader
from rig_protocol.errors import DataError
from rig_protocol.frame_unit import (
    MAX_SEALED_SIZE,
    MIN_SEALED_SIZE,
    leading_seal,
    parse_unit,
    sealed_place,
)
from rig_protocol.frames import EncodedFrame
from rig_protocol.message_bytes import MAX_RANGES
from rig_protocol.messages import WHOLE_FRAME, Resend
from rig_protocol.open_unit import MAX_TRIES, REORDER_NS, OpenUnit
from rig_protocol.resend_budget import ResendBudget
from rig_protocol.security import FrameSeal
from rig_protocol.smoothed_delay import SmoothedDelay

# 200 ms of reordering at 30 frames/s is 6 frames; 8 bound the memory at 16 MiB a camera.
MAX_OPEN_UNITS = 8
# One second at 30 frames/s: outlasts every open unit.
NUMBER_WINDOW = 32
# A paced frame takes up to one frame interval; the rest is the network's, resends included.
GRACE_NS = 200_000_000

# A verified number moves the window; until one comes, losses are remembered for as many frames: 34 s.
_MAX_GIVEN_UP = 1024
# Late fragments follow soon after their unit was given up.
_MAX_LOST_KEYS = 64
_MAX_FRAGMENTS = 2**16
# No honest sender cuts smaller: 1796 fragments are the most that a unit has.
_MIN_PAYLOAD = MIN_DATAGRAM_SIZE - FRAGMENT_HEADER_SIZE
# Buffers of units that are done, for those to come: a camera has one or two open at a time.
_MAX_SPARE = 2
_NEVER_NS = 2**63 - 1
# NumPy's fixed cost pays from about so many payloads on.
_FEW = 10


class _UnitKey(NamedTuple):
    """What all fragments of one unit agree on, within one session."""

    frame_number: int
    seal: int
    unit_size: int
    payload_size: int


class _Unseen:
    """A frame of which nothing has come: later ones, or the agent's heartbeat, tell that it was sent."""

    __slots__ = ("ask_ns", "deadline_ns", "tries")

    def __init__(self, ask_ns: int, deadline_ns: int) -> None:
        self.ask_ns, self.deadline_ns, self.tries = ask_ns, deadline_ns, 0


class Reassembler:
    """Reassembles the frames of one session; counts into `counters`.

    `due_ns` is never later than the moment at which `handle_timeout` has something to do.
    """

    def __init__(
        self,
        camera_id: int,
        fps: float,
        counters: CameraCounters,
        seal: FrameSeal,
        budget: ResendBudget | None = None,
    ) -> None:
        """`budget`: what all cameras may ask for again; None: as much as they like."""
        self._camera_id = camera_id
        self._interval_ns = round(1e9 / fps)
        self._counters = counters
        self._seal = seal
        self._budget = budget or ResendBudget()
        self._frame_bytes = 1  # of the latest frame
        self._open: dict[_UnitKey, OpenUnit] = {}  # oldest first
        self._spare: list[bytearray] = []
        self._lost_keys: dict[_UnitKey, None] = {}  # oldest first
        self._window_start = 0
        # Frame numbers from the window's start on. Apart, so that no flood of forged headers, each of them
        # given up, makes us forget what was delivered and take it again.
        self._delivered: set[int] = set()
        self._given_up: dict[int, None] = {}  # oldest first
        self._unseen: dict[int, _Unseen] = {}  # by frame number, within the window
        self._next_number = 0  # the highest number heard of, and one
        self._sure_number = 0  # the same, of what is authentic
        # An agent answers within a turn of its loop and a round trip; its bursts keep a pace of their own.
        self._answers = SmoothedDelay(6_000_000, 2_000_000, 50_000_000)
        self._pace = SmoothedDelay(5_000_000, 3_000_000, max(self._interval_ns, 5_000_000))
        self.due_ns = _NEVER_NS

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
        key = _UnitKey(first.frame_number, first.seal, first.unit_size, first.payload_size)
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
        if 0 < start == unit.edge:
            self._pace.add(now_ns - unit.last_ns)
        self._counters.resent += unit.take(start, stop, now_ns, self._answers)
        self._counters.fragments += count
        if not unit.missing:
            return self._complete(key, first, unit)
        self._wake_at(min(unit.due_ns, now_ns + self._pace.bound_ns))
        return None

    def heard_of(self, frames: int, now_ns: int) -> None:
        """The agent says that it has sent so many frames of this session."""
        self._sure_number = max(self._sure_number, frames)
        if frames - self._next_number <= NUMBER_WINDOW:
            self._miss_before(frames, now_ns)

    def handle_timeout(self, now_ns: int) -> list[Resend]:
        """Give up the units whose time is over; what to ask the agent for again."""
        self._expire(now_ns)
        requests = self._ask_for_units(now_ns) + self._ask_for_unseen(now_ns)
        dues = [min(unit.due_ns, unit.deadline_ns) for unit in self._open.values()]
        dues += [min(unseen.ask_ns, unseen.deadline_ns) for unseen in self._unseen.values()]
        self.due_ns = min(dues, default=_NEVER_NS)
        return requests

    def close(self) -> None:
        """The session is over: what was sent and is not whole is lost."""
        self._move_window(self._sure_number)
        for key in list(self._open):
            self._counters.incomplete += 1
            self._give_up(key)

    # ---- asking again

    def _ask_for_units(self, now_ns: int) -> list[Resend]:
        requests = []
        for key, unit in self._open.items():
            size = FRAGMENT_HEADER_SIZE + key.payload_size
            afford = partial(self._budget.grant, piece_bytes=size, now_ns=now_ns)
            ranges = unit.ask(now_ns, self._pace.bound_ns, self._answers, afford)
            self._counters.requested += sum(count for _, count in ranges)
            parts = (tuple(ranges[k : k + MAX_RANGES]) for k in range(0, len(ranges), MAX_RANGES))
            requests += [Resend(key.frame_number, part) for part in parts]
        return requests

    def _ask_for_unseen(self, now_ns: int) -> list[Resend]:
        requests = []
        for number, unseen in list(self._unseen.items()):
            if unseen.deadline_ns <= now_ns or unseen.tries == MAX_TRIES:
                del self._unseen[number]  # it counts as missing when it leaves the window
            elif unseen.ask_ns <= now_ns:
                unseen.ask_ns = now_ns + (self._answers.bound_ns << min(unseen.tries + 1, 4))
                if self._budget.grant(1, self._frame_bytes, now_ns):
                    unseen.tries += 1
                    requests.append(Resend(number, WHOLE_FRAME))
        return requests

    def _miss_before(self, number: int, now_ns: int) -> None:
        """All frames below `number` were sent: what has not come of them is missed."""
        begun = {key.frame_number for key in self._open}
        for unseen in range(max(self._next_number, number - NUMBER_WINDOW), number):
            if unseen in begun or unseen in self._given_up:  # its number came far ahead, and was not believed
                continue
            deadline_ns = now_ns + self._interval_ns + GRACE_NS
            self._unseen[unseen] = _Unseen(now_ns + REORDER_NS, deadline_ns)
            self._wake_at(now_ns + REORDER_NS)
        if number > self._next_number:
            for key, unit in self._open.items():
                if key.frame_number < number and unit.edge < unit.total:
                    unit.miss_tail(now_ns + REORDER_NS)
                    self._wake_at(unit.due_ns)
            self._next_number = number

    def _wake_at(self, due_ns: int) -> None:
        self.due_ns = min(self.due_ns, due_ns)

    # ---- units

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

    def _open_unit(self, key: _UnitKey, header: FragmentHeader, count: int, now_ns: int) -> OpenUnit | None:
        """A new unit, or None (counted) where the number is over or the header out of bounds."""
        counters, number = self._counters, key.frame_number
        if number < self._window_start or key in self._lost_keys:
            counters.late += count
        elif number in self._delivered:
            counters.duplicate += count
        elif key.unit_size > MAX_SEALED_SIZE:
            counters.oversized += count
        elif key.unit_size < MIN_SEALED_SIZE or key.payload_size < min(key.unit_size, _MIN_PAYLOAD):
            counters.bad_fragment += count
        else:
            return self._open_fitting(key, header, now_ns)
        return None

    def _open_fitting(self, key: _UnitKey, header: FragmentHeader, now_ns: int) -> OpenUnit:
        if len(self._open) == MAX_OPEN_UNITS:
            self._counters.evicted += 1
            self._give_up(next(iter(self._open)))
        deadline_ns = now_ns + self._interval_ns + GRACE_NS
        unit = OpenUnit(header, self._buffer(key.unit_size), deadline_ns, now_ns)
        unseen = self._unseen.pop(key.frame_number, None)
        unit.wholly_resent = unseen is not None and unseen.tries > 0
        self._open[key] = unit
        # A number far ahead is not believed before its frame is whole: it may be a bit error's.
        if key.frame_number < self._sure_number + NUMBER_WINDOW:
            self._miss_before(key.frame_number, now_ns)
            self._next_number = max(self._next_number, key.frame_number + 1)
        self._wake_at(deadline_ns)
        return unit

    def _complete(self, key: _UnitKey, header: FragmentHeader, unit: OpenUnit) -> EncodedFrame | None:
        try:
            frame = self._open_sealed(key, header, unit.content)
        except DataError:
            self._counters.corrupt += 1
            self._give_up(key)
            return None
        # What a bit error made of a header of this frame goes with it.
        for other in [k for k in self._open if k.frame_number == key.frame_number]:
            self._recycle(self._open.pop(other))
        self._given_up.pop(key.frame_number, None)
        self._delivered.add(key.frame_number)
        self._frame_bytes = key.unit_size
        self._sure_number = max(self._sure_number, key.frame_number + 1)
        self._next_number = max(self._next_number, self._sure_number)
        self._move_window(key.frame_number - NUMBER_WINDOW + 1)
        return frame

    def _open_sealed(self, key: _UnitKey, header: FragmentHeader, content: bytearray) -> EncodedFrame:
        sealed = memoryview(content)[: key.unit_size]
        if leading_seal(sealed) != key.seal:
            raise DataError("the fragments carry another seal than the unit")
        unit = self._seal.open(key.frame_number, sealed, sealed_place(header))
        if unit is None:
            raise DataError("the unit is not what the agent sealed")
        return parse_unit(unit, self._camera_id)

    def _expire(self, now_ns: int) -> None:
        while self._open:
            key, unit = next(iter(self._open.items()))
            if unit.deadline_ns > now_ns:
                return
            self._counters.incomplete += 1
            self._give_up(key)

    def _move_window(self, start: int) -> None:
        """Close the numbers below `start`; those neither delivered nor given up were never seen."""
        if start <= self._window_start:
            return
        for key in [k for k in self._open if k.frame_number < start]:
            self._counters.incomplete += 1
            self._give_up(key)
        delivered = {number for number in self._delivered if number < start}
        given_up = [number for number in self._given_up if number < start]
        self._counters.missing += start - self._window_start - len(delivered) - len(given_up)
        self._delivered -= delivered
        for number in given_up:
            del self._given_up[number]
        for number in [number for number in self._unseen if number < start]:
            del self._unseen[number]
        self._window_start = start

    def _give_up(self, key: _UnitKey) -> None:
        """Close a unit whose loss its caller has counted."""
        self._recycle(self._open.pop(key))
        self._lost_keys[key] = None
        if len(self._lost_keys) > _MAX_LOST_KEYS:
            del self._lost_keys[next(iter(self._lost_keys))]
        if key.frame_number not in self._delivered:
            self._given_up[key.frame_number] = None
        if len(self._given_up) > _MAX_GIVEN_UP:
            del self._given_up[next(iter(self._given_up))]

    # ---- buffers

    def _buffer(self, size: int) -> bytearray:
        """At least `size` bytes, used before where possible: fresh memory costs a page fault every 4 KiB."""
        for k, spare in enumerate(self._spare):
            if size <= len(spare):
                return self._spare.pop(k)
        return bytearray(min(size + size // 8, MAX_SEALED_SIZE))

    def _recycle(self, unit: OpenUnit) -> None:
        if len(self._spare) == _MAX_SPARE:
            self._spare.pop(0)
        self._spare.append(unit.content)


def _fits(first: FragmentHeader, count: int, size: int) -> bool:
    """True when `count` fragments of `size` payload bytes lie in the unit as SPEC section 3 cuts it."""
    last = (first.unit_size - 1) // first.payload_size
    stop = first.fragment_index + count
    if stop <= last:
        return size == first.payload_size
    last_size = first.unit_size - last * first.payload_size
    return stop == last + 1 and size == last_size and (count == 1 or size == first.payload_size)


def _copy(run: Buffer, count: int, content: bytearray, offset: int, size: int) -> None:
    """Payloads of a run into their place: one by one where they are few, else in one strided copy."""
    if count <= _FEW:
        place, source = memoryview(content), memoryview(run)
        for start in range(FRAGMENT_HEADER_SIZE, len(run), FRAGMENT_HEADER_SIZE + size):
            place[offset : offset + size] = source[start : start + size]
            offset += size
        return
    rows = np.frombuffer(run, dtype=np.uint8).reshape(count, FRAGMENT_HEADER_SIZE + size)
    target = np.frombuffer(content, dtype=np.uint8, count=count * size, offset=offset)
    target.reshape(count, size)[:] = rows[:, FRAGMENT_HEADER_SIZE:]
