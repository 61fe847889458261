"""One page that looks: what it wants, what it is sent, and what it has painted."""

import asyncio
import json
import struct
from collections.abc import Sequence
from typing import Any

from aiohttp import WSCloseCode, web

from rig_server.console.tiles import Look, Tile, TileRound

_MAX_UNPAINTED = 1  # messages: a second one would wait for the first to be painted, and show an older set


class Viewer:
    """Every kind of message has one place: a newer one replaces what a slow page was not sent yet."""

    def __init__(self, socket: web.WebSocketResponse) -> None:
        self._socket = socket
        self._waiting: dict[str, str | bytes] = {}
        self._something = asyncio.Event()
        self._number = 0
        self._unpainted: dict[int, tuple[int, ...]] = {}
        self.look: Look | None = None
        """None: the page shows no pictures, being hidden."""

    @property
    def ready(self) -> bool:
        """Whether it wants another round of tiles."""
        return self.look is not None and len(self._unpainted) < _MAX_UNPAINTED

    def show(self, look: Look | None) -> None:
        """It looks at something else from now on."""
        self.look = look
        self._unpainted.clear()
        self._waiting.pop("tiles", None)

    def tell(self, kind: str, message: str | bytes) -> None:
        """Send this when the page has taken what came before."""
        self._waiting[kind] = message
        self._something.set()

    def send_tiles(self, one_round: TileRound) -> None:
        """Send what it looks at of a round."""
        if self.look is None or not self.ready or "tiles" in self._waiting:
            return
        tiles = one_round.seen_by(self.look)
        if not tiles:
            return
        self._number += 1
        self._unpainted[self._number] = tuple(tile.received_ns for tile in tiles)
        self.tell("tiles", tiles_message(self._number, self.look, tiles))

    def painted(self, number: Any) -> tuple[int, ...]:
        """The page has painted a message; when the datagrams of its tiles had come, in rig time."""
        return self._unpainted.pop(number, ()) if isinstance(number, int) else ()

    async def close(self) -> None:
        """The server ends."""
        await self._socket.close(code=WSCloseCode.GOING_AWAY)

    async def send_on(self) -> None:
        """Send what there is, until the socket closes."""
        while not self._socket.closed:
            await self._something.wait()
            self._something.clear()
            while self._waiting:
                message = self._waiting.pop(next(iter(self._waiting)))
                if isinstance(message, str):
                    await self._socket.send_str(message)
                else:
                    await self._socket.send_bytes(message)


def tiles_message(number: int, look: Look, tiles: Sequence[Tile]) -> bytes:
    """A binary message: length of the header (u32, little-endian), header (JSON), JPEG files in its order."""
    header = {
        "kind": "tiles",
        "number": number,
        "mode": look.mode,
        "tiles": [
            {
                "camera": tile.camera_id,
                "width": tile.width,
                "height": tile.height,
                "full": tile.camera_id == look.enlarged,
                "bytes": len(tile.data),
            }
            for tile in tiles
        ],
    }
    return picture_message(header, [tile.data for tile in tiles])


def picture_message(header: dict[str, Any], pictures: Sequence[bytes]) -> bytes:
    """The same for any header."""
    text = json.dumps(header, separators=(",", ":")).encode()
    return b"".join([struct.pack("<I", len(text)), text, *pictures])
