"""The way to the server: its name, the interface that leads there, the kernel's buffers."""

import ipaddress
import socket
import struct

from rig_agent.config import AgentSettings
from rig_agent.doctor.finding import Check, Finding, failed, ok, skipped, warning
from rig_agent.doctor.machine import Machine
from rig_protocol.troubleshooting import Topic

_HEADERS = 28  # of IP and UDP, around a datagram
_ROUTES = "/proc/net/route"
_FULL_MBIT = 1000
_LOSSLESS_MBIT = 60  # one camera at 30 fps (docs/network.md)
_BUFFERS = {"wmem_default": "send", "rmem_default": "receive"}
_KERNELS_OWN_BYTES = 212_992


def network(machine: Machine, settings: AgentSettings) -> list[Finding]:
    """Name, interface and buffers."""
    buffers = [_buffers(machine)]
    host = settings.address[0]
    try:
        found = socket.getaddrinfo(host, settings.address[1], type=socket.SOCK_DGRAM)
    except OSError as error:
        text = f"the server's name {host} is not known: {error.strerror}"
        mend = f"getent ahosts {host} || sudo apt install libnss-mdns"
        return [failed(Check.SERVER_NAME, text, mend, Topic.NO_NETWORK), *buffers]
    address = str(min(found, key=lambda entry: entry[0] != socket.AF_INET)[4][0])
    known = ok(Check.SERVER_NAME, f"the server {host} is {address}")
    interface = _interface(machine, address)
    if interface is None:
        text = f"no route of IPv4 in {_ROUTES} names the interface to {address}"
        return [known, skipped(Check.LINK_SPEED, text), *buffers]
    return [known, *_mtu(machine, interface, settings.datagram_size), _speed(machine, interface), *buffers]


def _interface(machine: Machine, address: str) -> str | None:
    """By the longest prefix, then the least metric, as the kernel chooses."""
    to = ipaddress.ip_address(address)
    if to.is_loopback:
        return "lo"
    if to.version != 4:
        return None
    fitting = []
    for line in (machine.text(_ROUTES) or "").splitlines()[1:]:
        name, destination, _, _, _, _, metric, mask, *_ = line.split()
        network, bits = _little_endian(destination), _little_endian(mask)
        if int(to) & bits == network:
            fitting.append((bits.bit_count(), -int(metric), name))
    return max(fitting)[2] if fitting else None


def _little_endian(digits: str) -> int:
    return int(struct.unpack("<I", bytes.fromhex(digits))[0])


def _mtu(machine: Machine, interface: str, datagram_size: int) -> list[Finding]:
    mtu = machine.number(f"/sys/class/net/{interface}/mtu")
    if mtu is None:
        return []
    if mtu < datagram_size + _HEADERS:
        return [
            failed(
                Check.MTU,
                f"{interface} takes packets of {mtu} bytes, `datagram_size` {datagram_size} makes "
                f"{datagram_size + _HEADERS}",
                f"sudo ip link set {interface} mtu {datagram_size + _HEADERS}",
                Topic.NO_NETWORK,
            )
        ]
    return [ok(Check.MTU, f"{interface} takes packets of {mtu} bytes, ours have {datagram_size + _HEADERS}")]


def _speed(machine: Machine, interface: str) -> Finding:
    folder = f"/sys/class/net/{interface}"
    if machine.path(f"{folder}/wireless").exists():
        return warning(
            Check.LINK_SPEED,
            f"{interface} is wireless: frames come late and unevenly",
            "connect the Pi to the switch by cable",
            Topic.LOST_FRAMES,
            hardware=True,
        )
    mbit = machine.number(f"{folder}/speed")
    if mbit is None or mbit <= 0:
        return skipped(Check.LINK_SPEED, f"{interface} does not tell its speed")
    half = machine.text(f"{folder}/duplex") == "half"
    if mbit >= _FULL_MBIT and not half:
        return ok(Check.LINK_SPEED, f"{interface} runs at {mbit} Mbit/s")
    verdict = failed if mbit < _LOSSLESS_MBIT or half else warning
    return verdict(
        Check.LINK_SPEED,
        f"{interface} runs at {mbit} Mbit/s{', half duplex' if half else ''}: a lossless camera takes "
        f"{_LOSSLESS_MBIT}, a gigabit port with a damaged cable comes up like this",
        f"sudo ethtool {interface}",
        Topic.LOW_RATE,
        hardware=True,
    )


def _buffers(machine: Machine) -> Finding:
    sizes = {name: machine.number(f"/proc/sys/net/core/{name}") for name in _BUFFERS}
    known = {name: size for name, size in sizes.items() if size is not None}
    if not known:
        return skipped(Check.BUFFERS, "the kernel does not tell its socket buffers")
    small = [name for name, size in known.items() if size < _KERNELS_OWN_BYTES]
    told = ", ".join(f"{_BUFFERS[name]} {size // 1024} KiB" for name, size in known.items())
    if small:
        mend = "sudo sysctl -w " + " ".join(f"net.core.{name}={_KERNELS_OWN_BYTES}" for name in small)
        return warning(Check.BUFFERS, f"socket buffers are small: {told}", mend, Topic.LOST_FRAMES)
    return ok(Check.BUFFERS, f"socket buffers: {told}")
