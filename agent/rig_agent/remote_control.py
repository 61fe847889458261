"""What the server has this agent do: its own controls here, the camera's on the thread that reads it."""

import logging
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from rig_agent.capture import Capture
from rig_protocol.events import ControlRequested
from rig_protocol.messages import ControlValue

_log = logging.getLogger(__name__)

_LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR")
_MAX_ANSWERS = 32  # the server has one control under way; more are of sessions that have ended
_DEPTH = "depth"  # must not stay off when the server that switched it off has gone
_LAST_ANSWER_NS = 500_000_000  # in which a lost answer is asked for again before the agent restarts


class Answer(NamedTuple):
    """What became of a control, in words."""

    request: ControlRequested
    done: bool
    text: str


class RemoteControl:
    """Takes controls and collects their answers. `wake` is called, on any thread, when there is a new one."""

    def __init__(self, capture: Capture, wake: Callable[[], None]) -> None:
        self._capture, self._wake = capture, wake
        self._answers: deque[Answer] = deque(maxlen=_MAX_ANSWERS)
        self._depth_is_off = False
        self._restart_ns: int | None = None

    def take(self, request: ControlRequested, now_ns: int) -> None:
        """See to it that a control is done; returns at once."""
        match request.name:
            case "log_level":
                self._answer(request, *_set_log_level(request.value))
            case "restart_agent":
                self._restart_ns = now_ns + _LAST_ANSWER_NS
                self._answer(request, True, "the agent restarts")
            case _:
                self._capture.control(
                    request.name, request.value, lambda done, text: self._answer(request, done, text)
                )

    def session_ended(self) -> None:
        """Nobody is there any more to switch depth on again."""
        if self._depth_is_off:
            self._depth_is_off = False
            self._capture.control(_DEPTH, True, _log_what_was_done)

    def next_answer(self) -> Answer | None:
        """The oldest answer that was not fetched yet."""
        return self._answers.popleft() if self._answers else None

    def restart_due(self, now_ns: int) -> bool:
        """True when the program is to start anew."""
        return self._restart_ns is not None and now_ns >= self._restart_ns

    def _answer(self, request: ControlRequested, done: bool, text: str) -> None:
        _log.info("%s = %s by the server: %s", request.name, request.value, text)
        if done and request.name == _DEPTH:
            self._depth_is_off = not request.value
        self._answers.append(Answer(request, done, text))
        self._wake()


def _log_what_was_done(_done: bool, text: str) -> None:
    _log.info("the server has gone: %s", text)


def _set_log_level(value: ControlValue) -> tuple[bool, str]:
    level = str(value).upper()
    if level not in _LEVELS:
        return False, f"log_level is one of {', '.join(_LEVELS)}"
    logging.getLogger().setLevel(level)
    return True, f"the log tells {level} and what is worse"
