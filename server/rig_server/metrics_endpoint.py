"""The HTTP endpoint that Prometheus scrapes. Whoever asks, in whatever way, costs the rig little."""

import contextlib
import http.server
import io
import logging
import socket
import socketserver
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4

from rig_protocol.events import Address
from rig_server.exposition import RigCollector
from rig_server.metrics import RigStatus
from rig_server.tcp_socket import in_use_sentence, resolve
from rig_server.udp_socket import bind_error

logger = logging.getLogger(__name__)

_PATH = "/metrics"
_ENDS = (b"\r\n\r\n", b"\n\n")
_MAX_REQUEST_BYTES = 8192  # a scrape's request has some 500
_REQUEST_TIMEOUT_S = 1.0  # for the whole request, and once more for the answer
# Prometheus needs one; when there are more, the oldest gives way.
_MAX_CONNECTIONS = 8
# At most 100 connections a second are accepted, and a status is read four times: a flood of scrapes costs
# the receive path a few per cent of the interpreter's time.
_ACCEPT_PAUSE_S = 0.01
_PAGE_AGE_S = 0.25


def metrics_served(
    address: Address | None, read_status: Callable[[], RigStatus]
) -> contextlib.AbstractContextManager[object]:
    """Serve the metrics until the block ends; with None as the address, nothing.

    RigError when the port is in use, ConfigurationError when the address makes no sense.
    """
    return contextlib.nullcontext() if address is None else MetricsEndpoint(address, read_status)


class MetricsEndpoint:
    """Binds on construction, serves from `with` to the end of the block.

    `read_status` is called on threads of its own.
    """

    def __init__(self, address: Address, read_status: Callable[[], RigStatus]) -> None:
        registry = CollectorRegistry()
        registry.register(RigCollector(read_status))
        ProcessCollector(registry=registry)
        self._server = _bound_server(address, _Page(registry))
        self._thread = threading.Thread(
            target=self._server.serve_forever, name="metrics", kwargs={"poll_interval": 0.2}, daemon=True
        )

    @property
    def url(self) -> str:
        """What to scrape; the port is the real one when 0 was asked for."""
        host, port = self._server.server_address[:2]
        shown = f"[{host!s}]" if ":" in str(host) else host
        return f"http://{shown!s}:{port}{_PATH}"

    def __enter__(self) -> Self:
        """Begin."""
        self._thread.start()
        logger.info("metrics at %s", self.url)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the port and every connection."""
        self._server.shutdown()
        self._server.close_connections()
        self._server.server_close()


class _Page:
    """The text of a scrape, made anew when it has become old."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self._registry = registry
        self._lock = threading.Lock()  # guards what follows; one thread makes the page, the others wait
        self._text = b""
        self._made_s = -_PAGE_AGE_S

    def text(self) -> bytes:
        """All metrics in Prometheus' text format."""
        with self._lock:
            if time.monotonic() - self._made_s >= _PAGE_AGE_S:
                self._text = generate_latest(self._registry)
                self._made_s = time.monotonic()
            return self._text


class _Server(socketserver.ThreadingTCPServer):
    """A thread for each of a bounded number of connections."""

    allow_reuse_address = True
    request_queue_size = 16

    def __init__(self, family: int, where: Any, page: _Page) -> None:
        self.address_family = family
        self.page = page
        self._lock = threading.Lock()
        self._connections: dict[socket.socket, None] = {}  # oldest first
        super().__init__(where, _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Start a thread for a new connection."""
        with self._lock:
            if len(self._connections) >= _MAX_CONNECTIONS:
                oldest = next(iter(self._connections))
                del self._connections[oldest]
                _hang_up(oldest)
            self._connections[request] = None
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """The thread is done with its connection."""
        with self._lock:
            self._connections.pop(request, None)
        super().shutdown_request(request)

    def close_connections(self) -> None:
        """Hang up on everybody, so that no thread stays."""
        with self._lock:
            for connection in self._connections:
                _hang_up(connection)

    def service_actions(self) -> None:
        """After every connection and every fruitless wait."""
        time.sleep(_ACCEPT_PAUSE_S)

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ARG002  # the library's signature
        """The client went away, or was hung up on."""
        logger.debug("metrics for %s", client_address, exc_info=True)


class _Handler(http.server.BaseHTTPRequestHandler):
    """One request, one answer, within a time."""

    server: _Server

    def handle(self) -> None:
        """Read the whole request before it is looked at: no client can make that slow or large."""
        self.rfile.close()
        self.rfile = io.BytesIO(_read_request(self.connection))
        self.handle_one_request()

    def do_GET(self) -> None:
        """The metrics."""
        if self.path.split("?")[0] != _PATH:
            self.send_error(404, f"metrics are at {_PATH}")
            return
        try:
            text = self.server.page.text()
        except Exception:  # a bug in reading the status must not look like a rig without trouble
            logger.exception("the metrics cannot be read")
            self.send_error(500)
            return
        self.send_response(200)
        self.send_header("Content-Type", CONTENT_TYPE_PLAIN_0_0_4)
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text)

    def version_string(self) -> str:
        """Strangers need not know which Python this is."""
        return "rig-server"

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002  # the library's signature
        """Requests are no news."""
        logger.debug(format, *args)


def _read_request(connection: socket.socket) -> bytes:
    """Up to the blank line that ends it, or what came of it within time and size."""
    until_s = time.monotonic() + _REQUEST_TIMEOUT_S
    request = b""
    while not any(end in request for end in _ENDS) and len(request) < _MAX_REQUEST_BYTES:
        left_s = until_s - time.monotonic()
        if left_s <= 0:
            break
        connection.settimeout(left_s)
        part = connection.recv(_MAX_REQUEST_BYTES - len(request))
        if not part:
            break
        request += part
    connection.settimeout(_REQUEST_TIMEOUT_S)
    return request


def _hang_up(connection: socket.socket) -> None:
    """End a connection that a thread waits on; the thread closes it."""
    with contextlib.suppress(OSError):  # the client was quicker
        connection.shutdown(socket.SHUT_RDWR)


def _bound_server(address: Address, page: _Page) -> _Server:
    family, where = resolve(address, "metrics")
    try:
        return _Server(family, where, page)
    except OSError as error:
        otherwise = "choose another with --metrics (Prometheus' node exporter takes 9100, too)"
        raise bind_error(error, address, in_use_sentence(address, otherwise)) from error
