"""The agent's only socket and clock: a connected UDP socket that outlives every network trouble."""

import contextlib
import errno
import logging
import socket
import struct
import time
from dataclasses import dataclass

from rig_protocol.datagram import DatagramBatch
from rig_protocol.events import Address
from rig_protocol.troubleshooting import Topic, see

_log = logging.getLogger(__name__)

# linux/udp.h: the kernel, or the network card, cuts one large send into datagrams of a given size.
_SOL_UDP = 17
_UDP_SEGMENT = 103
_SO_MAX_PACING_RATE = 47  # <asm-generic/socket.h>; bytes a second
_MAX_SEGMENTS = 44  # 44 × 1472 B is the most that one 64-KiB IP packet carries; 45 are refused
_MAX_SEND_BYTES = 65_507

_NO_SEGMENTATION = {errno.EINVAL, errno.EIO, errno.ENOPROTOOPT, errno.EOPNOTSUPP}
_BUSY = {errno.EAGAIN, errno.EWOULDBLOCK, errno.ENOBUFS}
_MAX_DATAGRAMS_A_WAKE = 64  # so that a flood of datagrams cannot hold up sending
_RECEIVE_BYTES = 2048  # control messages are never split and fit one Ethernet frame


@dataclass(slots=True)
class TransportCounters:
    """Datagrams and what went wrong with them; nothing here ends the agent."""

    sent: int = 0
    bytes_sent: int = 0
    refused: int = 0
    """Answers that nobody listens on the server's port."""
    network_errors: int = 0
    """Sends that failed: interface down, no route, datagram larger than the path allows."""


def now_ns() -> int:
    """Agent time: CLOCK_MONOTONIC."""
    return time.monotonic_ns()


class Transport:
    """One server at a time. `open` resolves the name anew, so it is also the cure for a changed address."""

    def __init__(self, server: Address) -> None:
        """Open nothing yet."""
        self._server = server
        self._socket: socket.socket | None = None
        self._segmentation = True
        self._rate = 0
        self._last_error: str | None = None
        self.counters = TransportCounters()

    def open(self) -> bool:
        """(Re)connect; False, with the reason logged once, when name or route is missing."""
        self.close()
        try:
            family, address = _resolve(self._server)
            self._socket = socket.socket(family, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
            self._socket.connect(address)
            if self._rate:
                self.limit_rate(self._rate)
        except OSError as error:
            self._note(error)
            self.close()
            return False
        return True

    def limit_rate(self, bytes_per_s: float) -> None:
        """Let the kernel space the datagrams of a burst (SO_MAX_PACING_RATE).

        Works where the interface has the `fq` discipline; elsewhere Linux takes the option and ignores it,
        and our own pacing is all there is.
        """
        self._rate = int(bytes_per_s)
        if self._socket is not None:
            with contextlib.suppress(OSError):  # a kernel without it
                self._socket.setsockopt(socket.SOL_SOCKET, _SO_MAX_PACING_RATE, self._rate)

    def fileno(self) -> int | None:
        """For a selector; None while not open."""
        return None if self._socket is None else self._socket.fileno()

    def send(self, batch: DatagramBatch) -> int:
        """Hand datagrams to the kernel; how many it took: not all when its buffer is full or the net down."""
        if self._socket is None:
            return 0  # `open` has said why
        size = batch.segment_size
        at_once = min(_MAX_SEGMENTS, max(1, _MAX_SEND_BYTES // size)) if self._segmentation else 1
        done = 0
        while done < len(batch):
            stop = min(done + at_once, len(batch))
            try:
                self._send_once(self._socket, batch.part(done, stop), size if stop - done > 1 else None)
            except OSError as error:
                if at_once > 1 and error.errno in _NO_SEGMENTATION:
                    _log.info("UDP segmentation offload is not available (%s): sending one by one", error)
                    self._segmentation, at_once = False, 1
                    continue
                self._note(error)
                break
            done = stop
        self.counters.sent += done
        return done

    def send_datagram(self, data: bytes) -> None:
        """Send one control message; a lost one is repeated by the link."""
        self.send(DatagramBatch(data, len(data)))

    def receive(self) -> list[bytes]:
        """What has arrived, at most 64 datagrams."""
        received: list[bytes] = []
        while self._socket is not None and len(received) < _MAX_DATAGRAMS_A_WAKE:
            try:
                received.append(self._socket.recv(_RECEIVE_BYTES))
            except OSError as error:
                if error.errno in _BUSY:
                    break
                self._note(error)
                if error.errno != errno.ECONNREFUSED:
                    break
        return received

    def server_reached(self) -> None:
        """A session has begun: trouble that comes now is news, even if it is that of before."""
        self._last_error = None

    def close(self) -> None:
        """Close the socket; harmless when closed."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send_once(self, to: socket.socket, data: memoryview, segment_size: int | None) -> None:
        control = []
        if segment_size is not None:
            control = [(_SOL_UDP, _UDP_SEGMENT, struct.pack("=H", segment_size))]
        try:
            to.sendmsg([data], control)
        except ConnectionRefusedError:
            # The ICMP answer to an earlier datagram is reported once, here, instead of sending this one.
            self.counters.refused += 1
            to.sendmsg([data], control)
        self.counters.bytes_sent += len(data)

    def _note(self, error: OSError) -> None:
        """Count an error; log it when it differs from the last one since the server was reached."""
        if error.errno in _BUSY:
            return
        if error.errno == errno.ECONNREFUSED:
            self.counters.refused += 1
            return
        self.counters.network_errors += 1
        text = _explain(error)
        if text != self._last_error:
            _log.warning(
                "cannot reach %s:%d: %s; trying on", *self._server, text, extra=see(Topic.NO_NETWORK)
            )
            self._last_error = text


def _resolve(server: Address) -> tuple[int, tuple[str, int] | tuple[str, int, int, int]]:
    """Family and address of the server, IPv4 first: rig-server listens there unless told otherwise."""
    host, port = server
    found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    found.sort(key=lambda entry: entry[0] != socket.AF_INET)
    family, _, _, _, address = found[0]
    return family, address  # type: ignore[return-value]  # the other shapes belong to unknown families


def _explain(error: OSError) -> str:
    if error.errno == errno.EMSGSIZE:
        return "a datagram is larger than the path allows: lower `datagram_size`"
    return error.strerror or str(error)
