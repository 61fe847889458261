"""The server announces itself by mDNS, so that agents find it without its address.

Who is found this way is no more trusted than who is not: agent and server still prove to each other that they
hold the rig's key.
"""

import contextlib
import ipaddress
import logging
import platform
import socket
from collections.abc import Iterator, Sequence

from rig_protocol.datagram import SERVICE_TYPE, VERSION
from rig_protocol.events import Address
from rig_protocol.troubleshooting import Topic, see

logger = logging.getLogger(__name__)


@contextlib.contextmanager
def announced(address: Address, interfaces: Sequence[str] | None = None) -> Iterator[None]:
    """Announce meanwhile that a server listens at `address`; one that only this machine can reach is not.

    `interfaces`: addresses of this machine's; unset: all. Where the network forbids it, the log says so.
    """
    host, port = address
    if interfaces is None and _ip(host).is_loopback:
        yield
        return
    from zeroconf import Error as ZeroconfError
    from zeroconf import InterfaceChoice, ServiceInfo, Zeroconf

    try:
        zeroconf = Zeroconf(InterfaceChoice.All if interfaces is None else list(interfaces))
    except (OSError, RuntimeError) as error:
        _tell_failure(error)
        yield
        return
    name = platform.node().partition(".")[0] or "rig-server"
    service = ServiceInfo(
        SERVICE_TYPE,
        f"{name}-{port}.{SERVICE_TYPE}",  # two servers of one machine are told apart at once
        parsed_addresses=_reachable(host) if interfaces is None else list(interfaces),
        port=port,
        properties={"protocol": str(VERSION)},
        server=f"{name}.local.",
    )
    with contextlib.closing(zeroconf):
        try:
            zeroconf.register_service(service, allow_name_change=True)
        except (OSError, ZeroconfError) as error:
            _tell_failure(error)
        yield


def _tell_failure(error: Exception) -> None:
    text = "agents cannot find this server by mDNS (%r): give them its address"
    logger.warning(text, error, extra=see(Topic.NO_NETWORK))


def _reachable(host: str) -> list[str]:
    """Addresses at which other machines reach a server that listens at `host`; IPv4 first."""
    import ifaddr

    if not _ip(host).is_unspecified:
        return [str(_ip(host))]
    found = [ip.ip for adapter in ifaddr.get_adapters() for ip in adapter.ips if isinstance(ip.ip, str)]
    return [ip for ip in found if not ipaddress.ip_address(ip).is_loopback]


def _ip(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    try:
        return ipaddress.ip_address(host)
    except ValueError:  # a name; the receiver is bound to it already
        return ipaddress.ip_address(socket.gethostbyname(host))
