"""The console's door: nothing without the token, orders from its own page alone, cheap strangers."""

import asyncio
import contextlib
import json
import os
import re
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any, cast

import aiohttp
import pytest
from aiohttp import web

from rig_protocol.errors import ConfigurationError, RigError
from rig_server.console.access import console_token
from rig_server.console.camera_pictures import Mode
from rig_server.console.scene_proxy import SceneProxy
from rig_server.console.tiles import Look, Tile, TileRound
from rig_server.console.viewer import Viewer
from rig_server.console.web_server import WebServer

TOKEN = "a token of these tests"  # noqa: S105  # a stranger's guess at most
BEARER = {"Authorization": f"Bearer {TOKEN}"}
PATHS = ("/", "/page/main.js", "/history", "/live", "/scene", "/scene/", "/scene/x", "/nowhere")


class FakeDesk:
    """Remembers what was asked."""

    def __init__(self) -> None:
        self.acts: list[tuple[str, dict[str, Any]]] = []
        self.paints: list[tuple[int, ...]] = []

    def state(self) -> dict[str, Any]:
        return {"kind": "state", "acts": len(self.acts)}

    def history(self) -> dict[str, Any]:
        return {"series": {}}

    def act(self, action: str, wanted: dict[str, Any]) -> str:
        if action == "refuse":
            raise RigError("this rig will not")
        self.acts.append((action, wanted))
        return f"did {action}"

    def painted(self, received_ns: tuple[int, ...]) -> None:
        self.paints.append(received_ns)


class FakeScene:
    """In place of the proxy."""

    async def open(self) -> None:
        return

    async def close(self) -> None:
        return

    async def handle(self, _: web.Request) -> web.StreamResponse:
        return web.Response(text="scene")


@pytest.fixture
def desk() -> FakeDesk:
    return FakeDesk()


@pytest.fixture
def server(desk: FakeDesk) -> Iterator[WebServer]:
    with WebServer(("127.0.0.1", 0), TOKEN, desk, cast(SceneProxy, FakeScene())) as made:
        yield made


Ask = Callable[[aiohttp.ClientSession], Awaitable[Any]]


def browse(server: WebServer, ask: Ask, **options: Any) -> Any:
    """What a browser, or a program with these headers, is told."""

    async def run() -> Any:
        jar = aiohttp.CookieJar(unsafe=True)  # a browser takes cookies of an IP address, too
        timeout = aiohttp.ClientTimeout(total=20)
        async with aiohttp.ClientSession(server.url, cookie_jar=jar, timeout=timeout, **options) as session:
            return await ask(session)

    return asyncio.run(run())


async def come_in(session: aiohttp.ClientSession) -> None:
    async with session.get("/", params={"token": TOKEN}) as answer:
        assert answer.status == 200


def origin(server: WebServer) -> dict[str, str]:
    return {"Origin": server.url.rstrip("/")}


@pytest.mark.parametrize("headers", [{}, {"Authorization": "Bearer wrong"}, {"Authorization": TOKEN}])
def test_without_the_token_there_is_nothing_but_the_door(
    server: WebServer, desk: FakeDesk, headers: dict[str, str]
) -> None:
    async def ask(session: aiohttp.ClientSession) -> None:
        for path in PATHS:
            async with session.get(path) as answer:
                assert answer.status in (401, 403), path
                assert TOKEN not in await answer.text()
        async with session.post("/do/identify", json={}) as answer:
            assert answer.status == 403
        async with session.get("/", params={"token": "wrong"}) as answer:
            assert answer.status == 401
            assert "wants its token" in await answer.text()
            assert "Set-Cookie" not in answer.headers
        for path in ("/live", "/scene"):
            with pytest.raises(aiohttp.WSServerHandshakeError):
                await session.ws_connect(path)

    browse(server, ask, headers=headers)
    assert desk.acts == []


def test_the_link_becomes_a_cookie_that_no_script_and_no_other_site_gets(server: WebServer) -> None:
    async def ask(session: aiohttp.ClientSession) -> None:
        async with session.get("/", params={"token": TOKEN}) as answer:
            cookie = answer.headers["Set-Cookie"]
            assert "HttpOnly" in cookie
            assert "SameSite=Strict" in cookie
            assert answer.headers["Referrer-Policy"] == "no-referrer"
        async with session.get("/") as answer:
            page = await answer.text()
            assert answer.status == 200
            assert TOKEN not in page
            assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
        for file in re.findall(r'"(/page/[^"]+)"', page):
            async with session.get(file) as answer:
                assert answer.status == 200, file

    browse(server, ask)


def test_orders_and_sockets_of_a_browser_must_come_from_our_own_page(
    server: WebServer, desk: FakeDesk
) -> None:
    async def ask(session: aiohttp.ClientSession) -> None:
        await come_in(session)
        for headers in ({}, {"Origin": "http://evil.example"}, {"Origin": "null"}):
            async with session.post("/do/identify", json={}, headers=headers) as answer:
                assert answer.status == 403
            with pytest.raises(aiohttp.WSServerHandshakeError):
                await session.ws_connect("/live", headers=headers)
        async with session.post("/do/identify", json={"camera": 3}, headers=origin(server)) as answer:
            assert await answer.json() == {"ok": True, "text": "did identify"}

    browse(server, ask)
    assert desk.acts == [("identify", {"camera": 3})]


def test_what_cannot_be_done_is_answered_with_its_sentence(server: WebServer, desk: FakeDesk) -> None:
    async def ask(session: aiohttp.ClientSession) -> None:
        async with session.post("/do/refuse", json={}) as answer:
            assert (answer.status, await answer.json()) == (409, {"ok": False, "text": "this rig will not"})
        for body in (b"[1]", b"{", b"\xff", b"[" * 4000, b"17"):
            async with session.post("/do/identify", data=body) as answer:
                assert answer.status == 400, body
        async with session.post("/do/identify", data=b"{" + b" " * 100_000 + b"}") as answer:
            assert answer.status == 413

    browse(server, ask, headers=BEARER)
    assert desk.acts == []


def test_a_page_is_told_the_state_and_tells_what_it_painted(server: WebServer, desk: FakeDesk) -> None:
    async def ask(session: aiohttp.ClientSession) -> None:
        async with session.ws_connect("/live") as live:
            assert json.loads(await live.receive_str())["kind"] == "state"
            await live.send_json({"say": "look", "mode": "depth"})
            while server.looks != frozenset([Look(Mode.DEPTH)]):
                await live.receive()  # the next state
            server.publish_tiles(TileRound(0, {(Mode.DEPTH, 4, False): Tile(4, 240, 320, 77, b"jpeg")}))
            message = await live.receive()
            while message.type is not aiohttp.WSMsgType.BINARY:
                message = await live.receive()
            length = int.from_bytes(message.data[:4], "little")
            header = json.loads(message.data[4 : 4 + length])
            assert header["tiles"] == [{"camera": 4, "width": 240, "height": 320, "full": False, "bytes": 4}]
            assert message.data[4 + length :] == b"jpeg"
            await live.send_json({"say": "painted", "number": header["number"]})
            while not desk.paints:
                await live.receive()
            assert desk.paints == [(77,)]

    browse(server, ask, headers=BEARER)


@pytest.mark.parametrize(
    "nonsense",
    [
        *("", "{", "[]", "17", "null", "[" * 900, " " * 5000),
        '{"say": "look", "mode": "x-ray"}',
        '{"say": "look", "mode": "color", "enlarged": "all"}',
        '{"say": "rm"}',
    ],
)
def test_nonsense_ends_its_own_socket_alone(server: WebServer, nonsense: str) -> None:
    async def ask(session: aiohttp.ClientSession) -> None:
        async with session.ws_connect("/live") as good, session.ws_connect("/live") as bad:
            await bad.send_str(nonsense)
            async for message in bad:
                assert message.type is aiohttp.WSMsgType.TEXT
            assert bad.closed
            assert json.loads(await good.receive_str())["kind"] == "state"

    browse(server, ask, headers=BEARER)


def test_painted_is_believed_of_what_was_sent_alone(server: WebServer, desk: FakeDesk) -> None:
    async def ask(session: aiohttp.ClientSession) -> None:
        async with session.ws_connect("/live") as live:
            for number in (1, -1, None, 1e300, "1", [1]):
                await live.send_json({"say": "painted", "number": number})
            while len(desk.paints) < 6:
                await live.receive()

    browse(server, ask, headers=BEARER)
    assert desk.paints == [()] * 6


def test_pages_beyond_a_number_are_refused_in_a_sentence(server: WebServer) -> None:
    async def ask(session: aiohttp.ClientSession) -> None:
        pages = [await session.ws_connect("/live") for _ in range(16)]
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await session.ws_connect("/live")
        assert refused.value.status == 503
        await pages[0].close()
        for page in pages:
            await page.close()

    browse(server, ask, headers=BEARER)


def test_strangers_who_hold_connections_keep_nobody_out(server: WebServer) -> None:
    host, port = "127.0.0.1", int(server.url.rstrip("/").rpartition(":")[2])
    idle = [socket.create_connection((host, port)) for _ in range(40)]
    try:
        for one in idle:
            one.sendall(b"GET / HTTP/1.1\r\n")  # and never the rest

        async def ask(session: aiohttp.ClientSession) -> int:
            async with session.get("/") as answer:
                return answer.status

        assert browse(server, ask, headers=BEARER) == 200
        idle[0].settimeout(10)
        with contextlib.suppress(ConnectionResetError):  # the oldest gave way
            assert idle[0].recv(1) == b""
    finally:
        for one in idle:
            one.close()


def test_connections_that_ended_count_no_more(server: WebServer) -> None:
    """Of a prober that comes every minute for months, and of all that pages once fetched."""
    host, port = "127.0.0.1", int(server.url.rstrip("/").rpartition(":")[2])
    for header in ("", f"Authorization: Bearer {TOKEN}\r\n"):
        for _ in range(300):
            with socket.create_connection((host, port)) as one:
                one.sendall(f"GET / HTTP/1.1\r\nHost: x\r\n{header}Connection: close\r\n\r\n".encode())
                while one.recv(65536):
                    pass

    async def ask(session: aiohttp.ClientSession) -> None:
        async with session.ws_connect("/live") as live:
            for _ in range(3):  # it is not hung up on
                assert json.loads(await live.receive_str())["kind"] == "state"

    browse(server, ask, headers=BEARER)


@pytest.mark.parametrize(
    "garbage",
    [
        b"\x16\x03\x01 garbage\r\n\r\n",
        b"GET /" + b"b" * 20_000 + b" HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\n\r\n",
    ],
)
def test_garbage_of_strangers_fills_no_log(
    server: WebServer, garbage: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    host, port = "127.0.0.1", int(server.url.rstrip("/").rpartition(":")[2])
    with socket.create_connection((host, port), timeout=20) as one:
        one.sendall(garbage)
        assert b" 400 " in one.recv(65536)
    assert caplog.records == []


class BusyDesk(FakeDesk):
    """Its orders wait until `release`."""

    def __init__(self) -> None:
        super().__init__()
        self.begun, self.release = threading.Semaphore(0), threading.Event()

    def act(self, action: str, wanted: dict[str, Any]) -> str:
        self.begun.release()
        assert self.release.wait(60)
        return super().act(action, wanted)


def test_orders_that_wait_for_an_agent_hold_up_no_state() -> None:
    desk = BusyDesk()
    server = WebServer(("127.0.0.1", 0), TOKEN, desk, cast(SceneProxy, FakeScene()))
    threads = min(32, (os.cpu_count() or 1) + 4)  # that an event loop has for what waits

    async def ask(session: aiohttp.ClientSession) -> None:
        orders = [asyncio.create_task(session.post("/do/identify", json={})) for _ in range(threads)]
        for _ in range(threads):
            assert await asyncio.to_thread(desk.begun.acquire, timeout=20)
        try:
            async with session.ws_connect("/live") as live:
                for _ in range(4):  # the first is an old one
                    assert json.loads(await live.receive_str(timeout=10))["kind"] == "state"
        finally:
            desk.release.set()
        for order in orders:
            assert (await order).status == 200

    with server:
        browse(server, ask, headers=BEARER)


def test_an_order_under_way_does_not_keep_the_console_from_ending() -> None:
    desk = BusyDesk()
    server = WebServer(("127.0.0.1", 0), TOKEN, desk, cast(SceneProxy, FakeScene()))
    host, port = "127.0.0.1", int(server.url.rstrip("/").rpartition(":")[2])
    server.__enter__()
    ending = threading.Thread(target=server.__exit__, args=(None, None, None), daemon=True)
    with socket.create_connection((host, port), timeout=20) as one:
        head = f"POST /do/identify HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {TOKEN}\r\n"
        one.sendall(f"{head}Content-Length: 2\r\n\r\n{{}}".encode())
        assert desk.begun.acquire(timeout=20)
        ending.start()
        assert one.recv(65536) == b""  # it was hung up on
    desk.release.set()
    ending.join(20)
    assert not ending.is_alive()


class BrokenDesk(FakeDesk):
    """Has no state."""

    def __init__(self) -> None:
        super().__init__()
        self.asked = threading.Semaphore(0)

    def state(self) -> dict[str, Any]:
        self.asked.release()
        raise ValueError("no state")


def test_a_state_that_cannot_be_read_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    desk = BrokenDesk()
    with WebServer(("127.0.0.1", 0), TOKEN, desk, cast(SceneProxy, FakeScene())):
        for _ in range(3):
            assert desk.asked.acquire(timeout=20)
    assert [record.message for record in caplog.records].count("the console cannot read the rig's state") == 1


def test_a_port_in_use_and_an_unknown_host_are_sentences(server: WebServer, desk: FakeDesk) -> None:
    port = int(server.url.rstrip("/").rpartition(":")[2])
    scene = cast(SceneProxy, FakeScene())
    with pytest.raises(RigError, match=rf"TCP port {port} is in use: .* another with --console"):
        WebServer(("127.0.0.1", port), TOKEN, desk, scene)
    with pytest.raises(ConfigurationError, match=r"console address 'no\.such\.host\.invalid' is not known"):
        WebServer(("no.such.host.invalid", 0), TOKEN, desk, scene)


def test_the_token_is_that_of_a_private_file_or_a_fresh_one(tmp_path: Path) -> None:
    assert console_token(None) != console_token(None)
    assert len(console_token(None)) >= 32
    file = tmp_path / "token"
    file.write_text("0123456789abcdef\n")
    file.chmod(0o644)
    with pytest.raises(ConfigurationError, match="chmod 600"):
        console_token(file)
    file.chmod(0o600)
    assert console_token(file) == "0123456789abcdef"
    for short in ("", "0123456789", "0123456789 abcdef"):
        file.write_text(short)
        with pytest.raises(ConfigurationError, match="openssl rand"):
            console_token(file)
    with pytest.raises(ConfigurationError, match="cannot be read"):
        console_token(tmp_path / "none")


class StuckSocket:
    """A page that takes nothing."""

    closed = False


def a_round(index: int) -> TileRound:
    return TileRound(index, {(Mode.COLOR, 0, False): Tile(0, 240, 320, index, b"x")})


def test_a_slow_page_is_kept_the_newest_of_each_kind_and_nothing_else() -> None:
    async def run() -> None:
        viewer = Viewer(cast(web.WebSocketResponse, StuckSocket()))
        viewer.show(Look())
        for index in range(1000):
            viewer.tell("state", f"state {index}")
            viewer.send_tiles(a_round(index))
        assert viewer._waiting["state"] == "state 999"
        assert set(viewer._waiting) == {"state", "tiles"}
        assert len(viewer._unpainted) == 1

    asyncio.run(run())


def test_a_page_that_paints_slowly_is_sent_less() -> None:
    async def run() -> None:
        viewer = Viewer(cast(web.WebSocketResponse, StuckSocket()))
        viewer.show(Look())
        for index in range(5):
            viewer.send_tiles(a_round(index))
            viewer._waiting.clear()  # it was sent
        assert not viewer.ready
        assert viewer.painted(1) == (0,)
        assert viewer.ready
        assert viewer.painted(1) == ()
        viewer.show(None)
        assert not viewer.ready

    asyncio.run(run())
