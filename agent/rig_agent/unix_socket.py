"""The way to systemd: datagrams to a Unix socket."""

import socket


def send_to_unix_socket(data: bytes, address: str) -> None:
    """Send one datagram; OSError when nobody is there."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.sendto(data, address)
