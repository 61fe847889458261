"""The console's web server: one thread with an event loop that serves the page, its sockets and the scene."""

import asyncio
import contextlib
import json
import logging
import socket
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from importlib import resources
from types import TracebackType
from typing import Any, Protocol, Self

from aiohttp import WSMsgType, web
from aiohttp.http import HttpProcessingError

from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.events import Address
from rig_server.console.access import Gate
from rig_server.console.camera_pictures import Mode
from rig_server.console.scene_proxy import PATH as SCENE_PATH
from rig_server.console.scene_proxy import SceneProxy
from rig_server.console.strangers import Doorkeeper
from rig_server.console.tiles import Look, TileRound
from rig_server.console.viewer import Viewer
from rig_server.tcp_socket import listening_socket

logger = logging.getLogger(__name__)
_port_log = logging.getLogger(f"{__name__}.port")
_port_log.addFilter(lambda record: not _is_of_a_malformed_request(record))

_STATE_S = 0.5
_MAX_VIEWERS = 16
_MAX_BODY_BYTES, _MAX_WORD_BYTES = 4096, 1024
_TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' blob: data:; "
        "connect-src 'self'; frame-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Server": "rig-server",
}
_COME_IN = '<!doctype html><meta http-equiv="refresh" content="0;url=/"><title>Kinect rig</title>'
_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Desk(Protocol):
    """What stands behind the page; asked on threads that may wait."""

    def state(self) -> dict[str, Any]:
        """The state that every page is told."""
        ...

    def history(self) -> dict[str, Any]:
        """The last minutes of everybody's health."""
        ...

    def act(self, action: str, wanted: dict[str, Any]) -> str:
        """Do something; a sentence for the person. RigError or ConfigurationError when it cannot be done."""
        ...

    def painted(self, received_ns: tuple[int, ...]) -> None:
        """A page has painted tiles whose last datagrams had come then. Never waits."""
        ...


class WebServer:
    """Binds on construction, serves from `with` to the end of the block."""

    def __init__(self, address: Address, token: str, desk: Desk, scene: SceneProxy) -> None:
        """RigError when the port is in use, ConfigurationError when the address makes no sense."""
        self._socket = listening_socket(address, "console", "choose another with --console")
        self._gate = Gate(token, self._socket.getsockname()[1])
        self._desk, self._scene = desk, scene
        self._files = _page_files()
        self._viewers: set[Viewer] = set()
        self._state = ""
        self._tell_now = asyncio.Event()
        self._stopping = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name="console", daemon=True)

    @property
    def url(self) -> str:
        """Where the page is, without its token; the port is the real one when 0 was asked for."""
        host, port = self._socket.getsockname()[:2]
        if host in ("0.0.0.0", "::"):  # noqa: S104  # all interfaces: by name
            host = socket.gethostname()
        return f"http://{f'[{host}]' if ':' in host else host}:{port}/"

    @property
    def looks(self) -> frozenset[Look]:
        """What pages that are ready for more look at; any thread may ask."""
        return frozenset(viewer.look for viewer in list(self._viewers) if viewer.ready and viewer.look)

    @property
    def watched(self) -> bool:
        """Whether anybody looks at all."""
        return bool(self.modes)

    @property
    def modes(self) -> frozenset[Mode]:
        """In which modes anybody looks."""
        return frozenset(look.mode for viewer in list(self._viewers) if (look := viewer.look) is not None)

    def __enter__(self) -> Self:
        """Begin."""
        self._thread.start()
        self._ready.wait()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the port and every connection."""
        self._soon(self._stopping.set)
        self._thread.join()
        self._socket.close()

    def publish_tiles(self, one_round: TileRound) -> None:
        """Send tiles to all that look; any thread."""
        self._soon(self._send_tiles, one_round)

    def publish(self, kind: str, message: bytes, modes: tuple[Mode, ...]) -> None:
        """Send a message to all that look in one of these modes; any thread."""
        self._soon(self._send, kind, message, modes)

    def _soon(self, function: Callable[..., object], *arguments: object) -> None:
        loop = self._loop
        if loop is not None:
            with contextlib.suppress(RuntimeError):  # it has closed meanwhile
                loop.call_soon_threadsafe(function, *arguments)

    def _send_tiles(self, one_round: TileRound) -> None:
        for viewer in self._viewers:
            viewer.send_tiles(one_round)

    def _send(self, kind: str, message: bytes, modes: tuple[Mode, ...]) -> None:
        for viewer in self._viewers:
            if viewer.look is not None and viewer.look.mode in modes:
                viewer.tell(kind, message)

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except Exception:  # the rig goes on without a console
            logger.exception("the console has ended")
        finally:
            self._loop = None
            self._ready.set()

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        runner = web.AppRunner(
            self._app(), access_log=None, logger=_port_log, handle_signals=False, shutdown_timeout=1.0
        )
        await runner.setup()
        assert runner.server is not None  # noqa: S101  # so says its setup
        self._doorkeeper = Doorkeeper(runner.server)
        server = await self._loop.create_server(self._doorkeeper, sock=self._socket)
        try:
            async with server:
                self._ready.set()
                await self._stopping.wait()
        finally:
            await runner.cleanup()

    def _app(self) -> web.Application:
        app = web.Application(middlewares=[self._guard], client_max_size=_MAX_BODY_BYTES)
        app.router.add_get("/", self._index)
        app.router.add_get("/page/{name}", self._file)
        app.router.add_get("/live", self._live)
        app.router.add_get("/history", self._history)
        app.router.add_post("/do/{action}", self._act)
        app.router.add_get(SCENE_PATH, self._scene.handle)
        app.router.add_get(SCENE_PATH + "/{path:.*}", self._scene.handle)
        app.cleanup_ctx.append(self._lifetime)
        app.on_shutdown.append(self._hang_up)
        return app

    async def _lifetime(self, _: web.Application) -> AsyncIterator[None]:
        await self._scene.open()
        telling = asyncio.create_task(self._tell_state())
        yield
        telling.cancel()
        await asyncio.gather(telling, return_exceptions=True)
        await self._scene.close()

    async def _hang_up(self, _: web.Application) -> None:
        await asyncio.gather(*(viewer.close() for viewer in self._viewers), return_exceptions=True)

    @web.middleware
    async def _guard(self, request: web.Request, handler: _Handler) -> web.StreamResponse:
        """Let in who has the token; strangers get a page that asks for it."""
        response: web.StreamResponse
        token = request.query.get("token") if request.path == "/" else None
        refusal = self._gate.refusal(request)
        if token is not None and self._gate.is_token(token):
            response = web.Response(text=_COME_IN, content_type="text/html")
            response.set_cookie(self._gate.cookie, token, httponly=True, samesite="Strict")
        elif refusal is None:
            self._doorkeeper.admit(request)
            response = await handler(request)
        elif request.path == "/":
            response = web.Response(status=401, body=self._files["door.html"], content_type="text/html")
        else:
            response = web.Response(status=403, text=refusal + "\n")
        if not response.prepared:
            for name, value in _HEADERS.items():
                response.headers.setdefault(name, value)
        return response

    async def _index(self, _: web.Request) -> web.StreamResponse:
        return web.Response(body=self._files["index.html"], content_type="text/html", charset="utf-8")

    async def _file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]
        if name not in self._files:
            raise web.HTTPNotFound
        kind = _TYPES[name.rpartition(".")[2]]
        return web.Response(body=self._files[name], content_type=kind, charset="utf-8")

    async def _history(self, _: web.Request) -> web.StreamResponse:
        return web.json_response(await asyncio.to_thread(self._desk.history))

    async def _act(self, request: web.Request) -> web.StreamResponse:
        try:
            wanted = json.loads(await request.text() or "{}")
        except (ValueError, RecursionError):
            wanted = None
        if not isinstance(wanted, dict):
            return web.json_response({"ok": False, "text": "an order is a JSON object"}, status=400)
        try:
            text = await asyncio.to_thread(self._desk.act, request.match_info["action"], wanted)
        except (RigError, ConfigurationError) as error:
            return web.json_response({"ok": False, "text": str(error)}, status=409)
        finally:
            self._tell_now.set()
        return web.json_response({"ok": True, "text": text})

    async def _live(self, request: web.Request) -> web.StreamResponse:
        if len(self._viewers) >= _MAX_VIEWERS:
            raise web.HTTPServiceUnavailable(text=f"{_MAX_VIEWERS} pages look at this rig already")
        wire = web.WebSocketResponse(heartbeat=20.0, max_msg_size=_MAX_WORD_BYTES, compress=False)
        await wire.prepare(request)
        viewer = Viewer(wire)
        self._viewers.add(viewer)
        sending = asyncio.create_task(viewer.send_on())
        try:
            if self._state:
                viewer.tell("state", self._state)
            async for message in wire:
                if message.type is not WSMsgType.TEXT or not self._hear(viewer, message.data):
                    break
        finally:
            self._viewers.discard(viewer)
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            await wire.close()
        return wire

    def _hear(self, viewer: Viewer, text: str) -> bool:
        """A page says what it looks at, or what it has painted; False for what no page of ours says."""
        try:
            said = json.loads(text)
            match said.get("say"):
                case "painted":
                    self._desk.painted(viewer.painted(said.get("number")))
                case "look":
                    viewer.show(_look(said))
                case _:
                    return False
        except (ValueError, AttributeError, RecursionError):
            return False
        return True

    async def _tell_state(self) -> None:
        assert self._loop is not None  # noqa: S101  # it runs us
        failing = False
        # A thread of its own: orders may wait for an agent's answer on all those that there are.
        with ThreadPoolExecutor(1, thread_name_prefix="console state") as reader:
            while True:
                try:
                    state = await self._loop.run_in_executor(reader, self._desk.state)
                    self._state = json.dumps(state, separators=(",", ":"), allow_nan=False)
                    failing = False
                    for viewer in self._viewers:
                        viewer.tell("state", self._state)
                except Exception:  # the next one may be told
                    if not failing:
                        logger.exception("the console cannot read the rig's state")
                    failing = True
                await self._until_it_is_time()

    async def _until_it_is_time(self) -> None:
        self._tell_now.clear()
        # Not wait_for: before Python 3.12 that loses a cancellation which comes together with the event.
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_STATE_S):
                await self._tell_now.wait()


def _is_of_a_malformed_request(record: logging.LogRecord) -> bool:
    """Anybody may send one, as often as they like: it is answered, and no news."""
    error = record.exc_info[1] if record.exc_info else None
    return isinstance(error, HttpProcessingError | web.RequestPayloadError)


def _look(said: dict[str, Any]) -> Look | None:
    """What a page says that it looks at; ValueError for nonsense."""
    if said.get("mode") is None:
        return None
    enlarged = said.get("enlarged")
    if enlarged is not None and type(enlarged) is not int:
        raise ValueError(f"{enlarged!r} is no camera")
    return Look(Mode(said["mode"]), enlarged)


def _page_files() -> dict[str, bytes]:
    """The files of the page by name; there are no others."""
    folder = resources.files("rig_server.console") / "page"
    return {
        file.name: file.read_bytes() for file in folder.iterdir() if file.name.rpartition(".")[2] in _TYPES
    }
