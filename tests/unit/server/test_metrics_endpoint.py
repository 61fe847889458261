"""The endpoint over real sockets: what it serves, whom it refuses, whom it does not wait for."""

import http.client
import itertools
import os
import re
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.events import Address
from rig_server.exposition import families
from rig_server.metrics import RigStatus
from rig_server.metrics_endpoint import MetricsEndpoint, metrics_served
from support.full_status import full_status

LOOPBACK = ("127.0.0.1", 0)


@pytest.fixture
def endpoint() -> Iterator[MetricsEndpoint]:
    with MetricsEndpoint(LOOPBACK, full_status) as serving:
        yield serving


def address_of(endpoint: MetricsEndpoint) -> Address:
    match = re.fullmatch(r"http://(.*):(\d+)/metrics", endpoint.url)
    assert match is not None
    return match[1], int(match[2])


def scrape(url: str) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    with urllib.request.urlopen(url, timeout=20) as answer:  # noqa: S310  # our own loopback address
        assert answer.headers["Content-Type"].startswith("text/plain; version=0.0.4")
        text = answer.read().decode()
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def request(endpoint: MetricsEndpoint, method: str, path: str) -> int:
    connection = http.client.HTTPConnection(*address_of(endpoint), timeout=20)
    try:
        connection.request(method, path)
        return connection.getresponse().status
    finally:
        connection.close()


def hung_up_within(connection: socket.socket, seconds: float) -> bool:
    connection.settimeout(seconds)
    try:
        while connection.recv(65_536):
            pass
    except TimeoutError:
        return False
    except OSError:
        return True
    return True


def test_a_scrape_holds_the_values_of_the_status(endpoint: MetricsEndpoint) -> None:
    told = scrape(endpoint.url)
    for family in families(full_status()):
        for sample in family.samples:
            assert told[sample.name, tuple(sorted(sample.labels.items()))] == sample.value


def test_a_scrape_holds_what_shows_a_leak(endpoint: MetricsEndpoint) -> None:
    told = scrape(endpoint.url)
    assert told["process_resident_memory_bytes", ()] > 1 << 20
    assert told["process_open_fds", ()] > 2
    assert told["process_cpu_seconds_total", ()] > 0


def test_a_scrape_a_moment_later_reads_the_status_anew() -> None:
    counts = iter(range(1, 1000))
    with MetricsEndpoint(LOOPBACK, lambda: RigStatus((), complete=next(counts))) as endpoint:
        complete = ("rig_sets_total", (("outcome", "complete"),))
        first = scrape(endpoint.url)[complete]
        until_s = time.monotonic() + 20
        while scrape(endpoint.url)[complete] == first:
            assert time.monotonic() < until_s


def test_a_flood_of_scrapes_reads_the_status_only_a_few_times_a_second() -> None:
    reads = []

    def read() -> RigStatus:
        reads.append(time.monotonic())
        return RigStatus(())

    with MetricsEndpoint(LOOPBACK, read) as endpoint:
        for _ in range(40):
            scrape(endpoint.url)
    assert all(later - earlier > 0.2 for earlier, later in itertools.pairwise(reads))


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/metrics", 200),
        ("GET", "/metrics?name[]=x", 200),
        ("GET", "/", 404),
        ("GET", "/../../etc/passwd", 404),
        ("POST", "/metrics", 501),
    ],
)
def test_only_the_metrics_are_there_and_only_to_be_read(
    endpoint: MetricsEndpoint, method: str, path: str, status: int
) -> None:
    assert request(endpoint, method, path) == status


def test_a_status_that_cannot_be_read_is_an_error_and_the_next_scrape_is_served(
    caplog: pytest.LogCaptureFixture,
) -> None:
    answers = iter([RuntimeError("a bug"), RigStatus(())])

    def read() -> RigStatus:
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    with MetricsEndpoint(LOOPBACK, read) as endpoint:
        assert request(endpoint, "GET", "/metrics") == 500
        assert request(endpoint, "GET", "/metrics") == 200
    assert "the metrics cannot be read" in caplog.text


def test_clients_that_say_nothing_hold_nobody_up_and_are_hung_up_on(endpoint: MetricsEndpoint) -> None:
    with ExitStack() as stack:
        idle = [stack.enter_context(socket.create_connection(address_of(endpoint))) for _ in range(30)]
        assert scrape(endpoint.url)
        named = [thread for thread in threading.enumerate() if "process_request" in thread.name]
        assert len(named) <= 9  # eight connections, and one thread that is about to end
        assert all(hung_up_within(connection, 20) for connection in idle)


def test_a_client_that_sends_a_byte_now_and_then_is_hung_up_on(endpoint: MetricsEndpoint) -> None:
    with socket.create_connection(address_of(endpoint)) as slow:
        until_s = time.monotonic() + 20
        slow.settimeout(0.2)
        alive = True
        while alive:
            assert time.monotonic() < until_s
            try:
                slow.sendall(b"G")
                alive = slow.recv(1) != b""
            except TimeoutError:
                continue
            except OSError:
                alive = False
    assert scrape(endpoint.url)


def test_garbage_is_answered_or_hung_up_on_and_changes_nothing(endpoint: MetricsEndpoint) -> None:
    rng = np.random.default_rng(5)
    requests = [
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",  # a TLS hello
        b"GET /metrics HTTP/9.9\r\n\r\n",
        b"GET /metrics HTTP/1.1\r\n" + b"X: y\r\n" * 500 + b"\r\n",
        b"GET /" + b"a" * 20_000,
        b"\r\n\r\n",
        *(rng.bytes(int(size)) + b"\r\n\r\n" for size in rng.integers(1, 10_000, 20)),
    ]
    for each in requests:
        with socket.create_connection(address_of(endpoint)) as stranger:
            try:
                stranger.sendall(each)
            except OSError:
                continue  # hung up on before it was through
            assert hung_up_within(stranger, 20)
    assert scrape(endpoint.url)


def test_a_request_by_hand_with_plain_newlines_is_served(endpoint: MetricsEndpoint) -> None:
    with socket.create_connection(address_of(endpoint), timeout=20) as stranger:
        stranger.sendall(b"GET /metrics HTTP/1.0\n\n")
        assert stranger.recv(20).startswith(b"HTTP/1.0 200")


def test_closing_hangs_up_on_everybody_and_frees_the_port() -> None:
    with MetricsEndpoint(LOOPBACK, full_status) as endpoint:
        address = address_of(endpoint)
        waiting = socket.create_connection(address)
    with waiting, pytest.raises(OSError):  # noqa: PT011  # refused or reset, as the kernel likes
        socket.create_connection(address).recv(1)
    with MetricsEndpoint(address, full_status) as endpoint:
        assert scrape(endpoint.url)
    assert not [thread for thread in threading.enumerate() if "process_request" in thread.name]


def test_a_port_in_use_is_refused_with_what_to_do(endpoint: MetricsEndpoint) -> None:
    with pytest.raises(RigError, match=r"TCP port \d+ is in use: .*ss -tlnp.* another with --metrics"):
        MetricsEndpoint(address_of(endpoint), full_status)


def test_an_address_of_another_machine_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"no interface of this machine has address 192.0.2.1"):
        MetricsEndpoint(("192.0.2.1", 0), full_status)


def test_without_an_address_nothing_is_served() -> None:
    with metrics_served(None, full_status) as nothing:
        assert nothing is None


def test_rig_server_serves_its_metrics_until_it_is_told_to_stop(tmp_path: Path) -> None:
    with subprocess.Popen(
        [
            sys.executable,
            "-m",
            "rig_server.cli",
            *("--listen", "127.0.0.1:0", "--insecure", "--metrics", "0"),
        ],
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    ) as server:
        assert server.stderr is not None
        lines = iter(server.stderr.readline, "")
        url = next(match[0] for line in lines if (match := re.search(r"http://\S+", line)))
        assert scrape(url)["rig_sets_total", (("outcome", "complete"),)] == 0
        server.terminate()
        assert server.wait(timeout=20) == 0
