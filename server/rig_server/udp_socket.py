"""The server's UDP socket: bound or refused with what to do, its receive buffer, the kernel's options."""

import errno
import logging
import socket
import struct

from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.events import Address
from rig_protocol.troubleshooting import Topic, see

logger = logging.getLogger(__name__)

# <asm-generic/socket.h>, <linux/sock_diag.h>: Python names none of them.
_SO_RCVBUFFORCE = 33
_SO_MEMINFO = 55
_MEMINFO_SIZE = 36  # nine counts of 32 bits; the first is what the receive queue takes


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
        in_use = (
            f"UDP port {port} is in use: stop the other rig-server "
            f"(`systemctl stop rig-server`, `ss -ulpn sport = :{port}`) or choose another with --listen"
        )
        raise bind_error(error, address, in_use) from error
    return bound


def bind_error(error: OSError, address: Address, in_use: str) -> RigError:
    """What to tell the operator when a socket cannot be bound; `in_use`: when the port is taken."""
    host, port = address
    if error.errno == errno.EADDRINUSE:
        return RigError(in_use, Topic.PORT_IN_USE)
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
                extra=see(Topic.SMALL_RECEIVE_BUFFER),
            )
    return _granted(bound)


def _granted(bound: socket.socket) -> int:
    """The kernel doubles what was asked for to hold its own book-keeping, and reports the double."""
    return bound.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2


def waiting_bytes(bound: socket.socket) -> int:
    """How much of the kernel's receive buffer is taken; 0 where it does not tell."""
    try:
        counts = bound.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO_SIZE)
        return int(struct.unpack_from("=I", counts)[0])
    except (OSError, struct.error):  # closed, or an old kernel
        return 0


def switch_on(bound: socket.socket, level: int, option: int) -> bool:
    """Set an option to 1; False where the kernel lacks it."""
    try:
        bound.setsockopt(level, option, 1)
    except OSError:
        return False
    return True
