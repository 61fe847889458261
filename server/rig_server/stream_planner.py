"""What every camera sends, and when: steps down when the link is too small, and up again. No clock, no I/O.

The link's owner tells who joins and leaves and which frames came, calls `update` a few times a second, sends
each agent its choice, and logs the notes. One thread.
"""

import ipaddress
import logging
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from rig_protocol.events import Address
from rig_protocol.frames import EncodedFrame
from rig_protocol.messages import Hello, StreamChoice
from rig_server import plan_words
from rig_server.config import LinkSettings
from rig_server.link_budget import Pacing
from rig_server.link_demand import Demand, LinkDemand
from rig_server.loss_watch import LossWatch
from rig_server.step_patience import StepPatience
from rig_server.stream_ladder import TOP, Level, ladder

_ROOM = 0.9  # a better level must leave a tenth of what may be used, or the next cloud ends it
# A gigabit port that came up as a 100-Mbit one carries a tenth. Losses below that are no overload.
_LEAST_OVERLOAD = 0.1
_SAME_STEP = (0.9, 1.2)  # times the present step: within, agents keep theirs
_LEAST_SPARE = 0.01  # of the port, for resends on a link that frames fill
_MAX_NOTES = 32  # an owner that never takes them loses the oldest


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a camera cannot be welcome, and what would fit."""

    text: str


@dataclass(frozen=True, slots=True)
class Note:
    """One line for the operator; `severity` is a level of `logging`."""

    severity: int
    text: str


class StreamPlanner:
    """The level on which all cameras stand, and their slots."""

    def __init__(self, settings: LinkSettings, expected: int | None = None) -> None:
        """`expected`: cameras that will come; the link is shared out for all of them from the first on."""
        self._settings = settings
        self._demand = LinkDemand(settings, expected or 0)
        self._levels = ladder(settings.jpeg) if settings.adapt else (TOP,)
        self._level = TOP
        self._choices: dict[int, StreamChoice] = {}
        self._pacing: Pacing | None = None
        self._latest = self._demand.at(TOP, 0)
        self._loss = LossWatch()
        self._notes: deque[Note] = deque(maxlen=_MAX_NOTES)
        self._now_ns = 0
        self._patience = StepPatience(settings.step_up_s)
        self._told_of_overload = False

    @property
    def choices(self) -> Mapping[int, StreamChoice]:
        """The latest choice of every camera, by id."""
        return MappingProxyType(self._choices)

    @property
    def demand(self) -> Demand:
        """The load that the choices put on the link; any thread may ask."""
        return self._latest

    @property
    def pacing(self) -> Pacing | None:
        """Steps and bursts; None before the first camera."""
        return self._pacing

    @property
    def spare_bytes_s(self) -> float | None:
        """What the port carries beside the frames, at least a hundredth; None where nothing loads it."""
        port_bytes_s = self._demand.port.udp_bytes_s
        if not self._latest.udp_bytes_s:
            return None
        return max(port_bytes_s - self._latest.udp_bytes_s, _LEAST_SPARE * port_bytes_s)

    @property
    def summary(self) -> str:
        """One sentence on what is sent now and what that takes."""
        return plan_words.summary(self._latest, self._demand.port)

    def take_notes(self) -> list[Note]:
        """What happened since the last call."""
        notes = list(self._notes)
        self._notes.clear()
        return notes

    def camera_joined(
        self, camera_id: int, hello: Hello, address: Address, now_ns: int
    ) -> StreamChoice | Refusal:
        """The choice for a camera that asks to join; a refusal, without effect, when there is no room.

        The others' choices may change with it.
        """
        self._now_ns = now_ns
        first = not self._choices
        self._demand.join(camera_id, hello, _is_loopback(address))
        level = self._best_from(TOP if first else self._level)
        demand = self._demand.at(level, now_ns)
        if not self._demand.fits(demand) and self._adds_load(camera_id):
            return self._refuse(camera_id, demand)
        if first:
            self._start(level)
        elif level != self._level:
            self._step_down(level)
        self._share_out()
        return self._choices[camera_id]

    def objection(self, camera_id: int, hello: Hello, address: Address, now_ns: int) -> str | None:
        """Why a camera that says hello has no room, and what would fit; None where it has. Without effect."""
        if camera_id in self._choices:
            return None
        self._demand.join(camera_id, hello, _is_loopback(address))
        demand = self._demand.at(self._best_from(self._level if self._choices else TOP), now_ns)
        text = (
            self._refusal_text(demand)
            if not self._demand.fits(demand) and self._adds_load(camera_id)
            else None
        )
        self._demand.leave(camera_id)
        return text

    def camera_left(self, camera_id: int, now_ns: int) -> None:
        """A camera has gone; its share is used again once it stays away."""
        self._now_ns = now_ns
        self._demand.leave(camera_id)
        self._share_out()

    def frame_received(self, frame: EncodedFrame) -> None:
        """A frame came whole; cheap."""
        self._demand.frame_received(frame, self._now_ns)

    def update(self, now_ns: int, lost: Mapping[int, int] | None = None) -> Mapping[int, StreamChoice]:
        """The choices for now. `lost`: frames lost by camera id since the start, where that is known."""
        self._now_ns = now_ns
        remote = self._demand.remote_ids
        losses = {i: count for i, count in (lost or {}).items() if i in remote}
        self._loss.update(self._demand.received, losses, now_ns)
        demand = self._demand.at(self._level, now_ns)
        too_much = not self._demand.fits(demand)
        if self._patience.too_long_over(too_much, now_ns):
            self._answer_overload(demand)
        if not too_much:
            self._told_of_overload = False
            if self._loss.overloaded:
                self._answer_loss(demand)
            else:
                self._look_up()
        self._keep_pace()
        return self.choices

    # ---- down and up

    def _answer_overload(self, demand: Demand) -> None:
        """Down to what fits, or a word when there is nothing below."""
        level = self._best_from(self._level)
        if level != self._level:
            self._patience.overload_ended_step(self._now_ns)
            self._step_down(level)
            self._share_out()
        elif not self._told_of_overload:
            self._told_of_overload = True
            self._note(logging.WARNING, plan_words.no_way_down(demand, self._demand, self._settings.adapt))

    def _answer_loss(self, demand: Demand) -> None:
        """The sizes say that it fits, the losses that it does not: one level down."""
        level = self._below(self._level)
        if level is None or demand.wire_bytes_s < _LEAST_OVERLOAD * self._demand.port.wire_bytes_s:
            return
        reason = plan_words.losses(self._loss.share, demand, self._demand.port)
        self._patience.overload_ended_step(self._now_ns)
        self._step_down(level, reason)
        self._share_out()

    def _step_down(self, level: Level, reason: str | None = None) -> None:
        before, after = self._demand.at(self._level, self._now_ns), self._demand.at(level, self._now_ns)
        reason = reason or plan_words.too_much(before, self._demand)
        self._note(logging.WARNING, plan_words.step_down(reason, after))
        self._level = level
        self._loss.answered()

    def _look_up(self) -> None:
        """The next better level, when it has fitted with room to spare for long enough."""
        level = self._above(self._level)
        room = level is not None and self._demand.fits(self._demand.at(level, self._now_ns), _ROOM)
        if self._patience.long_enough_under(room, self._now_ns) and level is not None:
            self._patience.stepped_up(self._now_ns)
            self._level = level
            self._share_out()
            self._note(logging.INFO, plan_words.room_again(self._latest, self._demand.port))

    # ---- levels

    def _best_from(self, level: Level) -> Level:
        """The best level from this one down that fits; the lowest when none does."""
        candidates = [one for one in self._levels if one >= level]
        fitting = (one for one in candidates if self._demand.fits(self._demand.at(one, self._now_ns)))
        return next(fitting, candidates[-1])

    def _below(self, level: Level) -> Level | None:
        return self._next_other([one for one in self._levels if one > level])

    def _above(self, level: Level) -> Level | None:
        return self._next_other([one for one in reversed(self._levels) if one < level])

    def _next_other(self, candidates: list[Level]) -> Level | None:
        """The first on which the cameras send anything else than now."""
        present = self._latest.streams
        others = (one for one in candidates if self._demand.at(one, self._now_ns).streams != present)
        return next(others, None)

    def _start(self, level: Level) -> None:
        self._patience.begin()
        self._level = TOP
        if self._demand.at(level, self._now_ns).streams != self._demand.at(TOP, self._now_ns).streams:
            self._step_down(level)
        elif self._demand.remote_ids:
            demand = self._demand.at(level, self._now_ns)
            self._note(logging.INFO, plan_words.summary(demand, self._demand.port))

    def _refusal_text(self, demand: Demand) -> str:
        ways = [self._demand.at(level, self._now_ns) for level in ladder(allow_jpeg=True)]
        fitting = next((one for one in ways if self._demand.fits(one)), None)
        return plan_words.refusal(demand, fitting, self._demand)

    def _refuse(self, camera_id: int, demand: Demand) -> Refusal:
        text = self._refusal_text(demand)
        self._demand.leave(camera_id)
        if camera_id in self._choices:  # an agent that came again with other streams
            self._share_out()
        return Refusal(text)

    def _adds_load(self, camera_id: int) -> bool:
        return camera_id in self._demand.remote_ids

    # ---- slots

    def _share_out(self) -> None:
        """Choices for all cameras on the present level. A slot is a camera's place among those here."""
        demand = self._latest = self._demand.at(self._level, self._now_ns)
        pacing = self._pacing = self._demand.pacing(demand)
        self._choices = {
            camera_id: StreamChoice(
                color_codec=demand.streams[camera_id].color_codec,
                depth_codec=demand.streams[camera_id].depth_codec,
                fps=demand.streams[camera_id].fps,
                slot=slot,
                slots=self._demand.slots,
                step_ns=pacing.step_ns,
                spread=pacing.spread,
            )
            for slot, camera_id in enumerate(self._demand.camera_ids)
        }

    def _keep_pace(self) -> None:
        """New steps when frames have become too large or much smaller for them."""
        self._latest = self._demand.at(self._level, self._now_ns)
        if self._pacing is None:
            return
        needed = self._demand.pacing(self._latest)
        change = needed.step_ns / self._pacing.step_ns
        if not _SAME_STEP[0] <= change <= _SAME_STEP[1] or needed.spread > self._pacing.spread:
            self._share_out()

    def _note(self, severity: int, text: str) -> None:
        self._notes.append(Note(severity, text))


def _is_loopback(address: Address) -> bool:
    """True for an agent on this machine: it loads no port."""
    try:
        return ipaddress.ip_address(address[0].partition("%")[0]).is_loopback
    except ValueError:
        return False
