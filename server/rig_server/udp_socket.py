"""The server's UDP socket: bound or refused with what to do, its receive buffer, the kernel's options."""

import errno
import logging
import socket

from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.events import Address

logger = logging.getLogger(__name__)

_SO_RCVBUFFORCE = 33  # <asm-generic/socket.h>; Python does not name it


def bound_udp_socket(address: Address) -> socket.socket:
    """A non-blocking UDP socket at `address`; RigError when the port is in use, ConfigurationError else."""
    host, port = address
    try:
        family, kind, protocol, _, where = socket.getaddrinfo(
            host, port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE
        )[0]
    except socket.gaierror as error:
        raise ConfigurationError(f"listen address {host!r} is not known: {error.strerror}") from error
    bound = socket.socket(family, kind | socket.SOCK_NONBLOCK, protocol)
    try:
        bound.bind(where)
    except OSError as error:
        bound.close()
        raise _bind_error(error, host, port) from error
    return bound


def _bind_error(error: OSError, host: str, port: int) -> RigError:
    if error.errno == errno.EADDRINUSE:
        return RigError(
            f"UDP port {port} is in use: stop the other rig-server "
            f"(`systemctl stop rig-server`, `ss -ulpn sport = :{port}`) or choose another with --listen"
        )
    if error.errno == errno.EADDRNOTAVAIL:
        return ConfigurationError(f"no interface of this machine has address {host}: see `ip addr`")
    return ConfigurationError(f"cannot listen on {host}:{port}: {error.strerror}")


def ask_for_receive_buffer(bound: socket.socket, wanted: int) -> int:
    """Ask for a receive buffer; the size that the kernel granted, with a warning when it is smaller."""
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, wanted)
    if _granted(bound) < wanted:
        try:
            bound.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, wanted)  # with CAP_NET_ADMIN
        except OSError:
            logger.warning(
                "the kernel grants a receive buffer of %d KiB instead of %d KiB; bursts may lose datagrams: "
                "sudo sysctl -w net.core.rmem_max=%d",
                _granted(bound) // 1024,
                wanted // 1024,
                wanted,
            )
    return _granted(bound)


def _granted(bound: socket.socket) -> int:
    """The kernel doubles what was asked for to hold its own book-keeping, and reports the double."""
    return bound.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2


def switch_on(bound: socket.socket, level: int, option: int) -> bool:
    """Set an option to 1; False where the kernel lacks it."""
    try:
        bound.setsockopt(level, option, 1)
    except OSError:
        return False
    return True
