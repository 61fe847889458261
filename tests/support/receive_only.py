"""The server's receive path without what comes after it: socket, link, whole frames, no decoder."""

import secrets
from collections.abc import Callable

from rig_protocol.codecs import COLOR_CODECS, DEPTH_CODECS
from rig_protocol.events import Address, ServerEvent
from rig_protocol.key_file import rig_key
from rig_protocol.roster import Roster
from rig_protocol.server_link import ServerLink
from rig_server.receiver import Receiver
from support.key_for_tests import rig_key_file

RECEIVE_BUFFER_BYTES = 8 << 20


def open_link() -> ServerLink:
    """A link that takes any camera."""
    return ServerLink(
        Roster(open=True), rig_key(rig_key_file(), False), secrets.token_bytes, COLOR_CODECS, DEPTH_CODECS
    )


def receive_only(
    link: ServerLink, address: Address, on_event: Callable[[ServerEvent], None], use_gro: bool = True
) -> Receiver:
    """A receiver to be started, with the buffer that a server asks for."""
    return Receiver(link, address, on_event, RECEIVE_BUFFER_BYTES, use_gro)
