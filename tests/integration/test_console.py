"""The console in a real browser, on a simulated rig: what a person does with it all day."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest
from aiohttp import web
from mcap.reader import make_reader
from playwright.sync_api import Page, WebSocket, expect

from rig_server.console.scene_proxy import SceneProxy
from rig_server.console.web_server import WebServer
from support.browser import browser, chromium_path

pytestmark = [
    pytest.mark.skipif(chromium_path() is None, reason="no Chromium on this machine: apt install chromium"),
    pytest.mark.timeout(
        420
    ),  # rendering rooms and WebGL in software, on a machine that does other things, too
]

CAMERAS = 3
PATIENCE_MS = 120_000
SETTINGS = """
[capture]
frames = 1
[console]
folder = "calibration"
[recording]
folder = "takes"
"""


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A running `rig-server --simulate`, and the link that it printed."""
    (tmp_path / "rig.toml").write_text(SETTINGS)
    words = ["-m", "rig_server.cli", "--simulate", str(CAMERAS), "--seed", "1", "--console", "127.0.0.1:0"]
    with subprocess.Popen(
        [sys.executable, *words],
        cwd=tmp_path,
        env={**os.environ, "RIG_SERVER_CONTROL_SOCKET": str(tmp_path / "control.sock")},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            told: list[str] = []
            while not (link := re.search(r"console at (http://\S+\?token=\S+)", "".join(told))):
                line = process.stdout.readline()
                assert line, "".join(told)
                told.append(line)
            yield process, link[1]
        finally:
            process.kill()


@pytest.fixture
def page() -> Iterator[Page]:
    path = chromium_path()
    assert path is not None
    with browser(path) as opened:
        made = opened.new_page(viewport={"width": 1280, "height": 860})
        made.set_default_timeout(PATIENCE_MS)
        expect.set_options(timeout=PATIENCE_MS)
        yield made


def tile_picture(page: Page) -> str:
    """The first tile's picture as it is now."""
    return str(page.evaluate("document.querySelector('.tile canvas').toDataURL()"))


def cloud_share(page: Page) -> float:
    """Share of the scene's pixels that are not its background."""
    shown = cv2.imdecode(np.frombuffer(page.locator("#scene").screenshot(), np.uint8), cv2.IMREAD_COLOR)
    away = np.abs(shown.astype(int) - shown[4, 4].astype(int)).max(axis=2)
    return float((away > 24).mean())


def until(live: WebSocket, holds: object, what: str) -> None:
    """Look again whenever the rig tells something, until it holds."""
    assert callable(holds)
    until_s = time.monotonic() + PATIENCE_MS / 1e3
    while not holds():
        assert time.monotonic() < until_s, what
        live.wait_for_event("framereceived")


def test_a_person_watches_calibrates_and_records_the_rig_in_a_browser(
    server: tuple[subprocess.Popen[str], str], page: Page, tmp_path: Path
) -> None:
    process, link = server
    errors: list[str] = []
    foreign: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    home = link.partition("?")[0]
    page.on(
        "request", lambda r: None if r.url.startswith((home, "data:", "blob:")) else foreign.append(r.url)
    )
    with page.expect_websocket(lambda socket: socket.url.endswith("/live")) as opened:
        page.goto(link)
    live = opened.value
    assert "token" not in page.url

    # Tiles: one a camera, and they move.
    expect(page.locator(".tile:not(.gone)")).to_have_count(CAMERAS)
    first = tile_picture(page)
    until(live, lambda: tile_picture(page) != first, "tiles do not move")
    expect(page.locator("#cloud-empty")).to_be_visible()
    expect(page.locator("#latency")).to_contain_text("datagram to painted tile")

    # The keyboard enlarges a camera and turns to depth; it closes again.
    page.keyboard.press("1")
    expect(page.locator("#detail-title")).to_have_text("cam01")
    page.keyboard.press("d")
    until(live, lambda: page.locator("#detail-canvas").evaluate("c => c.width") == 480, "it is not enlarged")
    page.keyboard.press("Escape")
    expect(page.locator("#detail")).to_be_hidden()

    # Calibrate, watch the coach, accept.
    page.keyboard.press("k")
    page.locator("#calibrate").click()
    expect(page.locator("#calibration-decision")).to_be_visible()
    expect(page.locator("#pairs tbody tr")).to_have_count(CAMERAS - 1)
    page.locator("#accept").click()
    expect(page.locator("#said")).to_contain_text("is in force")
    expect(page.locator("#figure-calibration")).to_contain_text(f"{CAMERAS} cameras")
    assert (tmp_path / "calibration" / "calibration.json").is_file()
    page.keyboard.press("k")

    # The cloud shows, and so does the panorama.
    until(live, lambda: cloud_share(page) > 0.02, "the cloud does not show")
    expect(page.locator("#panorama")).to_be_visible()

    # Record and stop: a take that another library reads.
    page.keyboard.press("r")
    expect(page.locator("#said")).to_contain_text("Recording to")
    expect(page.locator("#record-text")).to_have_text(re.compile(r"Stop 0:0[1-9]"))
    page.keyboard.press("r")
    expect(page.locator("#record-text")).to_have_text("Record")
    [take] = (tmp_path / "takes").glob("*.mcap")
    with take.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count > CAMERAS
    topics = {channel.topic for channel in summary.channels.values()}
    assert {"/cam00/color", "/cam02/depth"} <= topics

    assert errors == []
    assert foreign == []
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert "Traceback" not in output
    assert process.returncode == 0


class NoDesk:
    """Nothing is behind the page."""

    def state(self) -> dict[str, object]:
        return {"kind": "none"}

    def history(self) -> dict[str, object]:
        return {"series": {}}

    def act(self, action: str, _: object) -> str:
        return action

    def painted(self, _: object) -> None:
        return


class NoScene:
    """Nor is there a scene."""

    async def open(self) -> None:
        return

    async def close(self) -> None:
        return

    async def handle(self, _: web.Request) -> web.StreamResponse:
        return web.Response()


def test_a_page_whose_server_began_anew_asks_for_the_new_token(page: Page) -> None:
    scene = cast(SceneProxy, NoScene())
    with WebServer(("127.0.0.1", 0), "the first token!", NoDesk(), scene) as first:
        port = int(first.url.rstrip("/").rpartition(":")[2])
        page.goto(f"{first.url}?token=the first token!")
        expect(page.locator("#connection")).to_have_text("connected")
    expect(page.locator("#connection")).to_contain_text("trying again")
    with WebServer(("127.0.0.1", port), "the second token", NoDesk(), scene):
        page.locator("input[name=token]").fill("the second token")
        page.locator("button").click()
        expect(page.locator("#connection")).to_have_text("connected")
