"""The receiver: the server's only socket and clock, in a thread of its own around the link.

Linux hands over several datagrams of one sender in one call (UDP_GRO). Where it does not, each call gives
one datagram, and what waits of one sender is gathered here: the link gets batches either way.
"""

import contextlib
import logging
import select
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Protocol

from rig_protocol.datagram import DatagramBatch
from rig_protocol.errors import RigError
from rig_protocol.events import Address, ServerEvent
from rig_server.gatherer import Gatherer
from rig_server.udp_socket import ask_for_receive_buffer, bound_udp_socket, switch_on, waiting_bytes

logger = logging.getLogger(__name__)

# <linux/udp.h>, <asm-generic/socket.h>: Python names none of them.
_UDP_GRO = 104
_SO_RXQ_OVFL = 40

_MAX_RECEIVE = 65_536  # what one recvmsg returns at most, merged or not
_ANCILLARY_SIZE = 2 * socket.CMSG_SPACE(4)  # the segment size and the drop counter
_RECEIVES_A_TURN = 64  # before the link's own time-outs get their turn: 4 MB of merged datagrams
# Twelve agents send some 6600 bursts a second. Waking up for each costs more than taking them; a thousand
# wake-ups a second take several at a time, and a set is a millisecond later at most.
_TURN_S = 0.001
# Also where nothing comes and nothing is due the receiver turns, to show that it is alive.
_LONGEST_SLEEP_NS = 1_000_000_000


def rig_time_ns() -> int:
    """The rig clock: this machine's monotonic clock."""
    return time.monotonic_ns()


class Link(Protocol):
    """What the receiver asks of `rig_protocol.server_link.ServerLink`."""

    def receive_batch(self, batch: DatagramBatch, address: Address, now_ns: int) -> None:
        """Take datagrams of one sender; the buffer is reused after the call."""
        ...

    def receive_datagram(self, data: bytes, address: Address, now_ns: int) -> None:
        """Take one datagram."""
        ...

    def datagrams_to_send(self, now_ns: int) -> list[tuple[bytes, Address]]:
        """What to send now."""
        ...

    def next_timeout_ns(self) -> int | None:
        """When `handle_timeout` is due."""
        ...

    def handle_timeout(self, now_ns: int) -> None:
        """Time has come."""
        ...

    def next_event(self) -> ServerEvent | None:
        """The next event, or None."""
        ...

    def close(self, now_ns: int) -> None:
        """Say goodbye to every camera."""
        ...


class Receiver:
    """Binds on construction, runs the link in a thread from `start` to `stop`.

    On the receiver's thread `on_event` is called for every event, `on_turn` with the rig time after every
    wake-up; neither must block. After a failure of the socket the thread ends and `failure` holds the reason.
    """

    def __init__(
        self,
        link: Link,
        address: Address,
        on_event: Callable[[ServerEvent], None],
        receive_buffer_bytes: int,
        use_gro: bool = True,
        on_turn: Callable[[int], None] = lambda now_ns: None,  # noqa: ARG005  # the default does nothing
    ) -> None:
        self._link = link
        self._on_event, self._on_turn = on_event, on_turn
        self._socket = bound_udp_socket(address)
        self.receive_buffer_bytes = ask_for_receive_buffer(self._socket, receive_buffer_bytes)
        self.merges = use_gro and switch_on(self._socket, socket.IPPROTO_UDP, _UDP_GRO)
        self.counts_drops = switch_on(self._socket, socket.SOL_SOCKET, _SO_RXQ_OVFL)
        self.turns = 0  # rises while the receiver is alive
        self.kernel_drops = 0  # datagrams that found the socket's buffer full
        self.unsent = 0  # control datagrams that the network refused
        self.failure: Exception | None = None
        self._buffer = bytearray(_MAX_RECEIVE)
        self._gatherer = Gatherer()
        self._wake_receiver, self._waker = socket.socketpair()
        self._posted: deque[Callable[[int], None]] = deque()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="receiver", daemon=True)

    @property
    def address(self) -> Address:
        """Where the socket is bound; the port is the real one when 0 was asked for."""
        host, port = self._socket.getsockname()[:2]
        return str(host), int(port)

    @property
    def waiting_bytes(self) -> int:
        """How much of the kernel's receive buffer is taken."""
        return waiting_bytes(self._socket)

    def start(self) -> None:
        """Start receiving."""
        self._thread.start()

    def post(self, work: Callable[[int], None]) -> None:
        """Have something done soon on the receiver's thread, alone with the link; it gets the rig time.

        RigError when it does not run.
        """
        if self._stopping.is_set() or not self._thread.is_alive():
            raise RigError("the server does not run")
        self._posted.append(work)
        with contextlib.suppress(OSError):  # it stops this very moment
            self._waker.send(b"\0")

    def stop(self) -> None:
        """Say goodbye to the cameras and close the socket; harmless when already stopped."""
        self._stopping.set()
        if self._thread.is_alive():
            self._waker.send(b"\0")
            self._thread.join()
        for each in (self._socket, self._waker, self._wake_receiver):
            each.close()

    def _run(self) -> None:
        poller = select.poll()
        poller.register(self._socket, select.POLLIN)
        poller.register(self._wake_receiver, select.POLLIN)
        try:
            emptied = True
            while not self._stopping.is_set():
                ready = poller.poll(self._timeout_ms())
                if any(fd == self._wake_receiver.fileno() for fd, _ in ready):
                    self._wake_receiver.recv(_MAX_RECEIVE)  # then do what was posted: none is missed
                if emptied:
                    time.sleep(_TURN_S)
                emptied = self._receive_some()
                self._serve_link()
                self.turns += 1
            self._link.close(rig_time_ns())
            self._transmit()
        except Exception as error:  # whatever ends this thread must reach the program
            logger.exception("the receiver stopped")
            self.failure = error

    def _timeout_ms(self) -> float:
        due_ns, now_ns = self._link.next_timeout_ns(), rig_time_ns()
        sleep_ns = _LONGEST_SLEEP_NS if due_ns is None else min(due_ns - now_ns, _LONGEST_SLEEP_NS)
        return max(0.0, sleep_ns / 1e6)

    def _receive_some(self) -> bool:
        """Take what waits, but not for ever; True when nothing waits any more."""
        emptied = False
        for _ in range(_RECEIVES_A_TURN):
            try:
                size, ancillary, _, address = self._socket.recvmsg_into([self._buffer], _ANCILLARY_SIZE)
            except BlockingIOError:
                emptied = True
                break
            except ConnectionError:  # an agent's host told us that nobody listens there any more
                continue
            segment_size = self._read_ancillary(ancillary) or size
            received, sender = memoryview(self._buffer)[:size], address[:2]
            if segment_size < size:
                self._hand_over(self._gatherer.flush(sender), sender)
                self._hand_over((DatagramBatch(received, segment_size),), sender)
            elif size:
                self._hand_over(self._gatherer.add(received, sender), sender)
            else:  # no batch can hold an empty datagram, but the link counts it
                self._link.receive_datagram(b"", sender, rig_time_ns())
        for batch, sender in self._gatherer.flush_all():
            self._hand_over((batch,), sender)
        return emptied

    def _read_ancillary(self, ancillary: list[tuple[int, int, bytes]]) -> int | None:
        """Note the drop counter; the size of merged datagrams, where the kernel told one."""
        segment_size = None
        for level, kind, data in ancillary:
            if level == socket.IPPROTO_UDP and kind == _UDP_GRO:
                segment_size = _leading_int(data)
            elif level == socket.SOL_SOCKET and kind == _SO_RXQ_OVFL:
                self.kernel_drops = _leading_int(data)
        return segment_size

    def _hand_over(self, batches: Iterable[DatagramBatch], sender: Address) -> None:
        for batch in batches:
            self._link.receive_batch(batch, sender, rig_time_ns())
            self._deliver_events()

    def _serve_link(self) -> None:
        while self._posted:
            self._posted.popleft()(rig_time_ns())
        due_ns, now_ns = self._link.next_timeout_ns(), rig_time_ns()
        if due_ns is not None and due_ns <= now_ns:
            self._link.handle_timeout(now_ns)
        self._deliver_events()
        self._on_turn(now_ns)
        self._transmit()

    def _deliver_events(self) -> None:
        while (event := self._link.next_event()) is not None:
            self._on_event(event)

    def _transmit(self) -> None:
        for datagram, address in self._link.datagrams_to_send(rig_time_ns()):
            try:
                self._socket.sendto(datagram, address)
            except OSError as error:  # the route to one agent is no reason to stop for the others
                self.unsent += 1
                logger.debug("control datagram to %s was not sent: %s", address, error)


def _leading_int(data: bytes) -> int:
    """Native unsigned 32-bit value at the front of ancillary data."""
    return int(struct.unpack_from("=I", data)[0])
