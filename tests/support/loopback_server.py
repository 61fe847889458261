"""A server on loopback for tests of the agent: the real link behind a plain socket, in a thread."""

import secrets
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Self, TypeVar

from rig_protocol.codecs import COLOR_CODECS, DEPTH_CODECS
from rig_protocol.events import Address, ControlAnswered, FrameReceived, ServerEvent
from rig_protocol.frames import EncodedFrame
from rig_protocol.messages import ControlValue, StreamChoice
from rig_protocol.rig_key import RigKey
from rig_protocol.roster import Roster
from rig_protocol.server_link import ServerLink

E = TypeVar("E")
_PATIENCE_S = 20.0


class LoopbackServer:
    """Keeps every event; `wait_for` awaits one. `stop(silently=True)` dies without a goodbye."""

    def __init__(
        self,
        address: Address = ("127.0.0.1", 0),
        roster: Roster | None = None,
        rig_key: RigKey = RigKey.INSECURE,
    ) -> None:
        """Listen from now on; an open roster unless another one is given."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self._socket.bind(address)
        self._socket.setblocking(False)
        self.address: Address = self._socket.getsockname()
        self._link = ServerLink(
            roster or Roster(open=True), rig_key, secrets.token_bytes, COLOR_CODECS, DEPTH_CODECS
        )
        self._link.rig_clock = "rig:of-the-test"
        self.events: list[ServerEvent] = []
        self._asked: deque[tuple[int, str, ControlValue]] = deque()
        self._planned: deque[tuple[int, StreamChoice]] = deque()
        self._changed = threading.Condition()
        self._stopping = threading.Event()
        self._silently = False
        self._thread = threading.Thread(target=self._run, name="loopback server")
        self._thread.start()

    def frames(self) -> list[EncodedFrame]:
        """All frames so far."""
        with self._changed:
            return [event.frame for event in self.events if isinstance(event, FrameReceived)]

    @property
    def refusals(self) -> int:
        """Hellos refused so far; events of them are fewer."""
        return sum(count for name, count in self._link.rejected.items() if name.startswith("refused"))

    def wait_for(self, kind: type[E], count: int = 1) -> E:
        """The `count`-th event of a kind, awaited."""
        return self.wait_until(lambda: [one for one in self.events if isinstance(one, kind)][count - 1 :])[0]

    def wait_until(self, found: Callable[[], list[E]]) -> list[E]:
        """Await that `found` returns something; it is asked after every datagram."""
        with self._changed:
            assert self._changed.wait_for(lambda: bool(found()), _PATIENCE_S), f"only {self._summary()}"
            return found()

    def control(self, camera_id: int, name: str, value: ControlValue) -> ControlAnswered:
        """Have an agent do something; its answer, awaited. One at a time."""
        answered = len([event for event in self.events if isinstance(event, ControlAnswered)])
        self._asked.append((camera_id, name, value))
        return self.wait_for(ControlAnswered, answered + 1)

    def plan(self, camera_id: int, choice: StreamChoice) -> None:
        """What an agent is to send from now on."""
        self._planned.append((camera_id, choice))

    def stop(self, *, silently: bool = False) -> None:
        """End the server; harmless when ended."""
        self._silently = silently
        self._stopping.set()
        self._thread.join()
        self._socket.close()

    def __enter__(self) -> Self:
        """The server itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop."""
        self.stop()

    def _run(self) -> None:
        while not self._stopping.is_set():
            select.select([self._socket], [], [], 0.01)
            self._receive()
            while self._asked:
                self._link.control(*self._asked.popleft(), time.monotonic_ns())
            while self._planned:
                self._link.plan_stream(*self._planned.popleft())
            self._link.handle_timeout(time.monotonic_ns())
            self._send()
        if not self._silently:
            self._link.close(time.monotonic_ns())
            self._send()

    def _receive(self) -> None:
        while True:
            try:
                data, address = self._socket.recvfrom(65_535)
            except BlockingIOError:
                return
            self._link.receive_datagram(data, address, time.monotonic_ns())
            with self._changed:
                while (event := self._link.next_event()) is not None:
                    self.events.append(event)
                self._changed.notify_all()

    def _send(self) -> None:
        for data, address in self._link.datagrams_to_send(time.monotonic_ns()):
            self._socket.sendto(data, address)

    def _summary(self) -> str:
        names = [type(event).__name__ for event in self.events]
        return ", ".join(f"{names.count(name)} {name}" for name in sorted(set(names))) or "nothing"
