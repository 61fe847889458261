"""Passes requests for the scene on to viser, and its answers back: HTTP and WebSocket."""

import asyncio
import contextlib

import aiohttp
from aiohttp import web

from rig_server.console.scene import GUARD_HEADER

PATH = "/scene"
_MAX_FROM_PAGE = 1 << 20  # bytes of one message
_MAX_FROM_SCENE = 64 << 20
# viser's page is one file with its scripts in it, which make code and workers as they run.
_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:; "
    "connect-src 'self' ws: wss: blob: data:; frame-ancestors 'self'"
)
# Of its controls the console needs none: what neither is nor holds the canvas goes.
_CANVAS_ALONE = b"<style>body *:not(canvas):not(:has(canvas)){display:none!important}</style></head>"


class SceneProxy:
    """Lives within one event loop, from `open` to `close`."""

    def __init__(self, address: str, secret: str) -> None:
        self._base = f"http://{address}"
        self._headers = {GUARD_HEADER: secret}
        self._session: aiohttp.ClientSession | None = None

    async def open(self) -> None:
        """Begin."""
        self._session = aiohttp.ClientSession(headers=self._headers, cookie_jar=aiohttp.DummyCookieJar())

    async def close(self) -> None:
        """End."""
        if self._session is not None:
            await self._session.close()

    async def handle(self, request: web.Request) -> web.StreamResponse:
        """One request below PATH."""
        if self._session is None:
            raise web.HTTPServiceUnavailable(text="the scene is not ready")
        try:
            if request.headers.get("Upgrade", "").lower() == "websocket":
                return await self._socket(self._session, request)
            return await self._page(self._session, request)
        except aiohttp.ClientError as error:
            raise web.HTTPBadGateway(text="the scene does not answer") from error

    async def _page(self, session: aiohttp.ClientSession, request: web.Request) -> web.Response:
        path = request.path.removeprefix(PATH) or "/"
        async with session.get(self._base + path) as answer:
            body = await answer.read()
            kind = answer.headers.get("Content-Type", "application/octet-stream")
            headers = {"Content-Type": kind, "Content-Security-Policy": _POLICY}
            if kind.startswith("text/html"):
                body = body.replace(b"</head>", _CANVAS_ALONE, 1)
            back = web.Response(status=answer.status, body=body, headers=headers)
            back.enable_compression()
            return back

    async def _socket(self, session: aiohttp.ClientSession, request: web.Request) -> web.WebSocketResponse:
        wanted = request.headers.get("Sec-WebSocket-Protocol", "")
        protocols = tuple(name.strip() for name in wanted.split(",") if name.strip())
        async with session.ws_connect(
            self._base + "/", protocols=protocols, max_msg_size=_MAX_FROM_SCENE, compress=0
        ) as scene:
            page = web.WebSocketResponse(protocols=protocols, max_msg_size=_MAX_FROM_PAGE, compress=False)
            await page.prepare(request)
            # Whoever is slow holds the other up: viser then leaves out what has become old.
            async with contextlib.AsyncExitStack() as at_the_end:
                at_the_end.push_async_callback(page.close)
                tasks = [asyncio.ensure_future(_pass(scene, page)), asyncio.ensure_future(_pass(page, scene))]
                try:
                    await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    for task in tasks:
                        task.cancel()
                    await asyncio.gather(*tasks, return_exceptions=True)
            return page


async def _pass(
    source: web.WebSocketResponse | aiohttp.ClientWebSocketResponse,
    target: web.WebSocketResponse | aiohttp.ClientWebSocketResponse,
) -> None:
    """Pass messages on until either side closes."""
    async for message in source:
        if message.type is aiohttp.WSMsgType.BINARY:
            await target.send_bytes(message.data)
        elif message.type is aiohttp.WSMsgType.TEXT:
            await target.send_str(message.data)
        else:
            return
