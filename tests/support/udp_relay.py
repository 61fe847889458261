"""A bad network between real sockets: a relay before the server that harms datagrams as LossyLink does."""

import collections
import selectors
import socket
import threading
import time
from types import TracebackType
from typing import Self

from rig_protocol.testing import Faults, LossyLink

_MAX_DATAGRAM = 65535
_BUFFER_BYTES = 4 << 20
_IDLE_S = 0.02


class UdpRelay:
    """Agents speak to `port`; each gets a socket of its own towards the server, which tells them apart."""

    def __init__(self, server: tuple[str, int], faults: Faults, seed: int = 1) -> None:
        self._server, self._faults, self._seed = server, faults, seed
        self._selector = selectors.DefaultSelector()
        self._front = _bound_socket()
        self.port = int(self._front.getsockname()[1])
        self._selector.register(self._front, selectors.EVENT_READ)
        self._clients: dict[tuple[str, int], _Client] = {}
        self.unplugged = threading.Event()  # while set, nothing passes in either direction
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="udp-relay")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        for client in self._clients.values():
            client.back.close()
        self._front.close()
        self._selector.close()

    def done(self, what: str) -> int:
        """How many datagrams were "sent", "lost", "reordered", ... towards the server."""
        return sum(client.up.done[what] for client in self._clients.values())

    def _run(self) -> None:
        while not self._stop.is_set():
            for key, _ in self._selector.select(self._wait_s()):
                self._read(key.data)
            self._deliver()

    def _wait_s(self) -> float:
        links = [link for client in self._clients.values() for link in (client.up, client.down)]
        due_ns = [link.next_arrival_ns for link in links if link.next_arrival_ns is not None]
        return min([_IDLE_S, *(max(0.0, (due - time.monotonic_ns()) / 1e9) for due in due_ns)])

    def _read(self, client: "_Client | None") -> None:
        now_ns = time.monotonic_ns()
        try:
            if client is not None:
                client.down.send(client.back.recv(_MAX_DATAGRAM), now_ns)
                return
            datagram, address = self._front.recvfrom(_MAX_DATAGRAM)
        except ConnectionRefusedError:  # the server is down: the network does not care
            return
        self._client(address).up.send(datagram, now_ns)

    def _client(self, address: tuple[str, int]) -> "_Client":
        if address not in self._clients:
            client = _Client(self._server, self._faults, self._seed + 2 * len(self._clients))
            self._clients[address] = client
            self._selector.register(client.back, selectors.EVENT_READ, client)
        return self._clients[address]

    def _deliver(self) -> None:
        now_ns = time.monotonic_ns()
        if self.unplugged.is_set():
            for client in self._clients.values():
                for link in (client.up, client.down):
                    collections.deque(link.arrivals(now_ns), maxlen=0)
            return
        for address, client in self._clients.items():
            for datagram in client.up.arrivals(now_ns):
                client.send_to_server(datagram)
            for datagram in client.down.arrivals(now_ns):
                self._front.sendto(datagram, address)


class _Client:
    """One agent's two directions."""

    def __init__(self, server: tuple[str, int], faults: Faults, seed: int) -> None:
        self.up, self.down = LossyLink(seed, faults), LossyLink(seed + 1, faults)
        self.back = _bound_socket()
        self.back.connect(server)

    def send_to_server(self, datagram: bytes) -> None:
        try:
            self.back.send(datagram)
        except ConnectionRefusedError:
            return


def _bound_socket() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    sock.bind(("127.0.0.1", 0))
    return sock
