"""Rules of the transport: whole bursts go out, network trouble is counted and never raised."""

import errno
import logging
import socket
from collections.abc import Iterator

import pytest

from rig_agent.transport import Transport
from rig_protocol.datagram import DatagramBatch

SIZE = 1472


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(5)
        yield listener


@pytest.fixture
def transport(server: socket.socket) -> Iterator[Transport]:
    transport = Transport(server.getsockname())
    assert transport.open()
    yield transport
    transport.close()


def batch(datagrams: int) -> DatagramBatch:
    rows = [bytes([index]) * SIZE for index in range(datagrams - 1)]
    return DatagramBatch(b"".join(rows) + b"last", SIZE)


@pytest.mark.parametrize("datagrams", [1, 2, 44, 45, 60])
@pytest.mark.parametrize("segmentation", [True, False])
def test_datagrams_arrive_one_by_one_as_they_were(
    transport: Transport, server: socket.socket, datagrams: int, segmentation: bool
) -> None:
    transport._segmentation = segmentation
    sent = batch(datagrams)
    assert transport.send(sent) == datagrams
    assert [server.recv(2000) for _ in range(datagrams)] == [bytes(datagram) for datagram in sent]
    assert (transport.counters.sent, transport.counters.bytes_sent) == (datagrams, sent.total_bytes)


@pytest.mark.parametrize("refusal", [errno.EINVAL, errno.EIO])
def test_a_kernel_without_segmentation_gets_single_datagrams(
    transport: Transport, server: socket.socket, monkeypatch: pytest.MonkeyPatch, refusal: int
) -> None:
    send_once = transport._send_once

    def refuse_segments(to: socket.socket, data: memoryview, segment_size: int | None) -> None:
        if segment_size is not None:
            raise OSError(refusal, "no such option")
        send_once(to, data, segment_size)

    monkeypatch.setattr(transport, "_send_once", refuse_segments)
    assert transport.send(batch(10)) == 10
    assert len([server.recv(2000) for _ in range(10)]) == 10


def test_a_full_kernel_buffer_takes_a_part_and_is_no_error(
    transport: Transport, monkeypatch: pytest.MonkeyPatch
) -> None:
    transport._segmentation = False
    room = iter(range(3))

    def full_after_three(_socket: socket.socket, _data: memoryview, _size: int | None) -> None:
        if next(room, None) is None:
            raise BlockingIOError(errno.EAGAIN, "again")

    monkeypatch.setattr(transport, "_send_once", full_after_three)
    assert transport.send(batch(10)) == 3
    assert transport.counters.network_errors == 0


def test_a_server_that_is_not_up_is_normal(transport: Transport, server: socket.socket) -> None:
    server.close()
    for _ in range(5):
        transport.send_datagram(b"hello")
        transport.receive()
    assert transport.counters.refused > 0
    assert transport.counters.network_errors == 0


def test_a_server_that_comes_up_later_is_reached(transport: Transport, server: socket.socket) -> None:
    address = server.getsockname()
    server.close()
    transport.send_datagram(b"lost")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as restarted:
        restarted.bind(address)
        restarted.settimeout(5)
        transport.send_datagram(b"hello")
        assert restarted.recv(100) == b"hello"


def test_received_datagrams_come_in_order(transport: Transport, server: socket.socket) -> None:
    transport.send_datagram(b"hello")
    _, agent = server.recvfrom(100)
    for number in range(3):
        server.sendto(bytes([number]), agent)
    assert transport.receive() == [b"\0", b"\1", b"\2"]
    assert transport.receive() == []


def test_a_name_that_does_not_resolve_is_logged_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def unknown(*_args: object, **_options: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    transport = Transport(("rig-server.invalid", 4012))
    with caplog.at_level(logging.WARNING):
        assert [transport.open() for _ in range(3)] == [False] * 3
    assert caplog.messages == ["cannot reach rig-server.invalid:4012: Name or service not known; trying on"]
    assert transport.fileno() is None
    assert transport.send(batch(3)) == 0


def test_a_network_that_is_down_is_counted_and_reported_once(
    transport: Transport, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:

    def unreachable(_socket: socket.socket, _data: memoryview, _size: int | None) -> None:
        raise OSError(errno.ENETUNREACH, "Network is unreachable")

    monkeypatch.setattr(transport, "_send_once", unreachable)
    with caplog.at_level(logging.WARNING):
        assert [transport.send(batch(2)) for _ in range(3)] == [0, 0, 0]
        assert len(caplog.messages) == 1
        transport.server_reached()
        transport.send(batch(2))
        assert len(caplog.messages) == 2
    assert transport.counters.network_errors == 4


def test_a_datagram_larger_than_the_path_allows_says_what_to_change(
    transport: Transport, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def too_long(_socket: socket.socket, _data: memoryview, _size: int | None) -> None:
        raise OSError(errno.EMSGSIZE, "Message too long")

    monkeypatch.setattr(transport, "_send_once", too_long)
    with caplog.at_level(logging.WARNING):
        transport.send(batch(1))
    assert "lower `datagram_size`" in caplog.messages[0]
