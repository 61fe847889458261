"""The receiver over real loopback sockets, around a link that only listens."""

import logging
import queue
import socket
import struct
import threading
import time
from collections.abc import Iterator

import pytest

from rig_protocol.datagram import DatagramBatch
from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.events import Address, CameraLeft, ServerEvent
from rig_server.receiver import Receiver

LOOPBACK = ("127.0.0.1", 0)
UDP_SEGMENT = 103


class EchoLink:
    """Echoes every datagram to its sender and tells each batch as an event."""

    def __init__(self) -> None:
        self.events: list[ServerEvent] = []
        self.outgoing: list[tuple[bytes, Address]] = []
        self.batches: list[list[bytes]] = []
        self.timeouts_ns: list[int] = []
        self.due_ns: int | None = None
        self.broken = False

    def receive_batch(self, batch: DatagramBatch, address: Address, now_ns: int) -> None:
        if self.broken:
            raise ZeroDivisionError("a link that fails")
        self.last_address = address
        self.batches.append([bytes(datagram) for datagram in batch])
        self.outgoing += [(bytes(datagram), address) for datagram in batch]
        self.events.append(CameraLeft(len(batch), str(now_ns)))

    def receive_datagram(self, data: bytes, _address: Address, _now_ns: int) -> None:
        self.batches.append([data])

    def datagrams_to_send(self, now_ns: int) -> list[tuple[bytes, Address]]:
        self.served_ns = now_ns
        out, self.outgoing = self.outgoing, []
        return out

    def next_timeout_ns(self) -> int | None:
        return self.due_ns

    def handle_timeout(self, now_ns: int) -> None:
        self.timeouts_ns.append(now_ns)
        self.due_ns = None
        self.events.append(CameraLeft(0, "time-out"))

    def next_event(self) -> ServerEvent | None:
        return self.events.pop(0) if self.events else None

    def close(self, now_ns: int) -> None:
        self.closed_ns = now_ns
        if self.batches:
            self.outgoing.append((b"goodbye", self.last_address))


class Rigged:
    """A started receiver, its link and the events that came out."""

    def __init__(self, link: EchoLink, **options: bool) -> None:
        self.link = link
        self.events: queue.Queue[ServerEvent] = queue.Queue()
        self.receiver = Receiver(link, LOOPBACK, self.events.put, receive_buffer_bytes=65_536, **options)
        self.receiver.start()

    def wait_for_datagrams(self, count: int) -> None:
        seen = 0
        while seen < count:
            event = self.events.get(timeout=10)
            assert isinstance(event, CameraLeft)
            seen += event.camera_id


@pytest.fixture
def sender() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(LOOPBACK)
        udp.settimeout(10)
        yield udp


def send_in_one_call(udp: socket.socket, data: bytes, segment_size: int, address: Address) -> None:
    """One system call, several datagrams: what an agent does; skips where the kernel cannot."""
    try:
        udp.sendmsg([data], [(socket.IPPROTO_UDP, UDP_SEGMENT, struct.pack("=H", segment_size))], 0, address)
    except OSError as error:
        pytest.skip(f"this kernel has no UDP_SEGMENT: {error}")


@pytest.mark.parametrize("use_gro", [True, False])
def test_every_datagram_arrives_whole_and_in_order_merged_or_not(
    sender: socket.socket, use_gro: bool
) -> None:
    rigged = Rigged(EchoLink(), use_gro=use_gro)
    data = bytes(range(256)) * 40
    try:
        send_in_one_call(sender, data, 1472, rigged.receiver.address)
        rigged.wait_for_datagrams(7)
    finally:
        rigged.receiver.stop()
    datagrams = [datagram for batch in rigged.link.batches for datagram in batch]
    assert b"".join(datagrams) == data
    assert [len(datagram) for datagram in datagrams] == [1472] * 6 + [10240 - 6 * 1472]
    assert use_gro or not rigged.receiver.merges


def test_several_datagrams_come_in_one_batch_where_the_kernel_merges(sender: socket.socket) -> None:
    rigged = Rigged(EchoLink())
    try:
        if not rigged.receiver.merges:
            pytest.skip("this kernel has no UDP_GRO (Linux 5.0)")
        send_in_one_call(sender, bytes(14_720), 1472, rigged.receiver.address)
        rigged.wait_for_datagrams(10)
    finally:
        rigged.receiver.stop()
    assert len(rigged.link.batches) == 1


def test_answers_of_the_link_go_back_to_the_sender(sender: socket.socket) -> None:
    rigged = Rigged(EchoLink())
    try:
        sender.sendto(b"ping", rigged.receiver.address)
        assert sender.recv(100) == b"ping"
    finally:
        rigged.receiver.stop()


def test_a_receiver_to_which_nothing_comes_turns_all_the_same() -> None:
    """systemd's watchdog is fed by its turns: a rig whose cameras are all switched off is no failure."""
    turned: queue.Queue[int] = queue.Queue()
    receiver = Receiver(EchoLink(), LOOPBACK, lambda _event: None, 65_536, on_turn=turned.put)
    receiver.start()
    try:
        turned.get(timeout=10)
        turned.get(timeout=10)
        assert receiver.turns >= 1
    finally:
        receiver.stop()


def test_an_empty_datagram_reaches_the_link_which_counts_it(sender: socket.socket) -> None:
    rigged = Rigged(EchoLink())
    try:
        sender.sendto(b"", rigged.receiver.address)
        sender.sendto(b"x", rigged.receiver.address)
        rigged.wait_for_datagrams(1)
    finally:
        rigged.receiver.stop()
    assert rigged.link.batches == [[b""], [b"x"]]


def test_the_time_out_of_the_link_fires_without_any_traffic() -> None:
    link = EchoLink()
    link.due_ns = time.monotonic_ns() + 20_000_000
    due_ns = link.due_ns
    rigged = Rigged(link)
    try:
        assert rigged.events.get(timeout=10) == CameraLeft(0, "time-out")
    finally:
        rigged.receiver.stop()
    assert link.timeouts_ns[0] >= due_ns


def test_stopping_says_goodbye_ends_the_thread_and_frees_the_port(sender: socket.socket) -> None:
    link = EchoLink()
    rigged = Rigged(link)
    sender.sendto(b"hello", rigged.receiver.address)
    rigged.wait_for_datagrams(1)
    address = rigged.receiver.address
    rigged.receiver.stop()
    rigged.receiver.stop()
    assert sender.recv(100) == b"hello"
    assert sender.recv(100) == b"goodbye"
    assert "receiver" not in [thread.name for thread in threading.enumerate()]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        again.bind(address)


def test_a_sender_that_has_gone_does_not_stop_the_receiver(sender: socket.socket) -> None:
    rigged = Rigged(EchoLink())
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as short_lived:
            short_lived.sendto(b"a", rigged.receiver.address)
        rigged.wait_for_datagrams(1)
        sender.sendto(b"b", rigged.receiver.address)
        rigged.wait_for_datagrams(1)
    finally:
        rigged.receiver.stop()
    assert rigged.receiver.failure is None


def test_what_ends_the_thread_is_kept_for_the_program(
    sender: socket.socket, caplog: pytest.LogCaptureFixture
) -> None:
    link = EchoLink()
    link.broken = True
    rigged = Rigged(link)
    sender.sendto(b"x", rigged.receiver.address)
    rigged.receiver._thread.join(10)
    rigged.receiver.stop()
    assert isinstance(rigged.receiver.failure, ZeroDivisionError)
    assert "the receiver stopped" in caplog.text


def test_datagrams_that_the_kernel_dropped_are_counted(sender: socket.socket) -> None:
    rigged = Rigged(EchoLink())
    receiver = Receiver(EchoLink(), LOOPBACK, rigged.events.put, receive_buffer_bytes=65_536)
    rigged.receiver.stop()
    if not receiver.counts_drops:
        pytest.skip("this kernel has no SO_RXQ_OVFL")
    for _ in range(500):  # nobody receives yet: 700 KB into a buffer of 64 KiB
        sender.sendto(bytes(1400), receiver.address)
    receiver.start()
    try:
        while receiver.kernel_drops == 0:
            sender.sendto(bytes(1400), receiver.address)
            rigged.events.get(timeout=10)
    finally:
        receiver.stop()
    assert receiver.kernel_drops > 300


def test_a_port_in_use_says_what_to_do(sender: socket.socket) -> None:
    address = sender.getsockname()
    with pytest.raises(RigError, match=rf"UDP port {address[1]} is in use.*--listen"):
        Receiver(EchoLink(), address, print, 65_536)


@pytest.mark.parametrize("host", ["no.such.host.invalid", "192.0.2.1"])
def test_an_address_that_is_not_ours_is_a_configuration_error(host: str) -> None:
    with pytest.raises(ConfigurationError, match=host):
        Receiver(EchoLink(), (host, 0), print, 65_536)


def test_a_receive_buffer_that_the_kernel_refuses_names_the_sysctl(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("rig_server.udp_socket._SO_RCVBUFFORCE", 0xFFFF)  # as without CAP_NET_ADMIN
    wanted = 1 << 30
    with caplog.at_level(logging.WARNING):
        receiver = Receiver(EchoLink(), LOOPBACK, print, wanted)
    receiver.stop()
    assert receiver.receive_buffer_bytes < wanted
    assert f"sysctl -w net.core.rmem_max={wanted}" in caplog.text
