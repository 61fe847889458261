"""Listening TCP sockets, and what to do when the address is not to be had."""

import socket
from typing import Any

from rig_protocol.errors import ConfigurationError
from rig_protocol.events import Address
from rig_server.udp_socket import bind_error

_BACKLOG = 16


def resolve(address: Address, what: str) -> tuple[int, Any]:
    """Address family and where to bind; ConfigurationError for a host that nobody knows."""
    host, port = address
    try:
        family, _, _, _, where = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except socket.gaierror as error:
        raise ConfigurationError(f"{what} address {host!r} is not known: {error.strerror}") from error
    return family, where


def listening_socket(address: Address, what: str, otherwise: str) -> socket.socket:
    """Bound and listening. RigError when the port is in use (`otherwise`: what to do then)."""
    family, where = resolve(address, what)
    listening = socket.socket(family, socket.SOCK_STREAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(where)
        listening.listen(_BACKLOG)
        listening.setblocking(False)
    except OSError as error:
        listening.close()
        raise bind_error(error, address, in_use_sentence(address, otherwise)) from error
    return listening


def in_use_sentence(address: Address, otherwise: str) -> str:
    """How to find out who has the port."""
    port = address[1]
    return f"TCP port {port} is in use: see what listens there (`ss -tlnp sport = :{port}`) or {otherwise}"
