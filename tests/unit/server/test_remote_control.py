"""Rules of remote control: nobody waits for answers that cannot come any more."""

import threading
from collections.abc import Callable
from typing import cast

from rig_protocol.events import ControlAnswered, Outcome
from rig_protocol.server_link import ServerLink
from rig_server.remote_control import RemoteControl


class SilentLink:
    """Gives tickets; no agent answers."""

    def control(self, camera_id: int, *_: object) -> int:
        return camera_id


def test_who_waits_for_an_answer_is_told_that_the_server_stops() -> None:
    answers: list[dict[int, ControlAnswered]] = []
    asked = threading.Event()

    def post(work: Callable[[int], None]) -> None:
        work(0)
        asked.set()

    remote = RemoteControl(cast(ServerLink, SilentLink()), post)
    waiting = threading.Thread(
        target=lambda: answers.append(remote.control([3, 4], "led", "green")), daemon=True
    )
    waiting.start()
    assert asked.wait(10)
    remote.take(ControlAnswered(3, 3, Outcome.DONE, "green"))
    remote.close()
    remote.close()
    waiting.join(10)  # its own patience is 25 s
    assert [{i: one.outcome for i, one in told.items()} for told in answers] == [
        {3: Outcome.DONE, 4: Outcome.UNANSWERED}
    ]
