"""Remote control: asks agents on the receiver's thread, and waits for their answers on the asker's own."""

import time
from collections.abc import Callable, Collection
from concurrent.futures import FIRST_COMPLETED, Future, wait

from rig_protocol.errors import ConfigurationError, LinkUsageError, RigError
from rig_protocol.events import ControlAnswered, Outcome
from rig_protocol.message_bytes import encode_body
from rig_protocol.messages import Control, ControlValue
from rig_protocol.server_link import ServerLink

Post = Callable[[Callable[[int], None]], None]
"""Has something done on the receiver's thread, which gives it the rig time."""

# The link gives an agent ten seconds for each control; one that another asker began may be under way.
_PATIENCE_S = 25.0


class RemoteControl:
    """Any number of threads may ask at once."""

    def __init__(self, link: ServerLink, post: Post) -> None:
        self._link, self._post = link, post
        self._asked: dict[int, Future[ControlAnswered]] = {}  # by ticket; the receiver's thread's own
        self._ended = Future[ControlAnswered]()  # wakes who waits

    def control(
        self, camera_ids: Collection[int], name: str, value: ControlValue
    ) -> dict[int, ControlAnswered]:
        """What became of it, by camera id, when all have answered. ConfigurationError: it cannot be told.

        An agent that does not answer in time is no error: the outcome says so.
        """
        try:
            encode_body(Control(1, name, value))
        except LinkUsageError as error:
            raise ConfigurationError(str(error)) from error
        futures = {camera_id: Future[ControlAnswered]() for camera_id in sorted(camera_ids)}
        until_s = time.monotonic() + _PATIENCE_S

        def ask(now_ns: int) -> None:
            for camera_id, future in futures.items():
                self._asked[self._link.control(camera_id, name, value, now_ns)] = future

        self._post(ask)
        waiting = set(futures.values())
        while waiting and not self._ended.done() and (left_s := until_s - time.monotonic()) > 0:
            waiting -= wait({*waiting, self._ended}, left_s, FIRST_COMPLETED).done
        silent = "the server stopped, or did not get to it"
        return {
            i: future.result() if future.done() else ControlAnswered(i, 0, Outcome.UNANSWERED, silent)
            for i, future in futures.items()
        }

    def close(self) -> None:
        """No answer will come any more: nobody waits for one. Harmless when already closed."""
        if not self._ended.done():
            self._ended.set_exception(RigError("the server does not run"))

    def take(self, answer: ControlAnswered) -> None:
        """On the receiver's thread: an agent has answered."""
        future = self._asked.pop(answer.ticket, None)
        if future is not None:
            future.set_result(answer)
