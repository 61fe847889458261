"""Datagrams outside of a session: hello, welcome, reject, unknown session. Their CRC finds accidents only.

What is secret of a hello and a welcome is sealed inside (`handshake.py`).
"""

import zlib

from rig_protocol.datagram import Buffer, MessageType, pack_prefix

# zlib.crc32 of the datagram without its crc field, which lies here.
_CRC_START, _CRC_END = 4, 8


def encode_clear(message_type: MessageType, body: bytes, id_: int) -> bytes:
    """The datagram of a message; `id_` is the hello's nonce, or a session id."""
    datagram = pack_prefix(message_type, 0, id_) + body
    return datagram[:_CRC_START] + clear_crc(datagram).to_bytes(4, "little") + datagram[_CRC_END:]


def clear_crc(datagram: Buffer) -> int:
    """CRC-32 of everything but the crc field."""
    return zlib.crc32(datagram[_CRC_END:], zlib.crc32(datagram[:_CRC_START]))
