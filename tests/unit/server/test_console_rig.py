"""The console on a rig folder: what it shows of it, and what it lets a person do."""

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp
import cv2
import numpy as np
import pytest
from rich.console import Console

from rig_protocol.errors import ConfigurationError, RigError
from rig_server import Rig
from rig_server.capture_log import CaptureLog
from rig_server.config import ConsoleSettings, RigSettings, WatchSettings
from rig_server.console.console import RigConsole
from rig_server.opening import Origin, open_rig
from rig_server.session_view import Phase
from support.box_room import calibration_of, ring_poses
from support.rig_processes import write_small_rig

CONSOLE = ConsoleSettings(listen="127.0.0.1:0", tile_hz=30, fused_hz=30)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    write_small_rig(tmp_path / "rig", cameras=3, frames=2)
    with Rig.open(tmp_path / "rig", RigSettings(console=CONSOLE)) as made:
        yield made


def test_everybody_who_looks_is_sent_the_sets_that_are_taken(rig: Rig) -> None:
    async def look(console: RigConsole) -> dict[str, Any]:
        home, _, token = console.link.partition("?token=")
        headers = {"Authorization": f"Bearer {token}"}
        async with (
            aiohttp.ClientSession(home, headers=headers) as session,
            session.ws_connect("/live") as live,
        ):
            await live.send_json({"say": "look", "mode": "depth"})
            while not console._server.watched:
                await live.receive()
            assert rig.next_panorama(5) is not None
            while True:
                message = await live.receive(timeout=20)
                if message.type is aiohttp.WSMsgType.BINARY:
                    break
        length = int.from_bytes(message.data[:4], "little")
        header: dict[str, Any] = json.loads(message.data[4 : 4 + length])
        first = message.data[4 + length :][: header["tiles"][0]["bytes"]]
        assert cv2.imdecode(np.frombuffer(first, np.uint8), cv2.IMREAD_COLOR).shape == (80, 60, 3)
        return header

    with RigConsole(rig) as console:
        header = asyncio.run(look(console))
    assert [tile["camera"] for tile in header["tiles"]] == [0, 1, 2]
    assert header["mode"] == "depth"


def test_its_state_is_plain_before_and_after_the_rig_ends(rig: Rig) -> None:
    with RigConsole(rig) as console:
        before = json.loads(json.dumps(console.state(), allow_nan=False))
        while not rig.ended:
            rig.next_panorama(5)
        rig.close()
        after = json.loads(json.dumps(console.state(), allow_nan=False))
    assert [camera["name"] for camera in before["cameras"]] == ["cam00", "cam01", "cam02"]
    assert before["orders"] is True
    assert before["calibration"] is None
    assert after["ended"] is True
    assert all(camera["away_s"] is not None for camera in after["cameras"])


@pytest.mark.parametrize(
    ("action", "wanted"),
    [
        ("format-disk", {}),
        ("identify", {"camera": [3]}),
        ("identify", {"camera": True}),
        ("expose", {"camera": 99}),
        ("stop-recording", {}),
        ("accept-calibration", {}),
        ("reject-calibration", {}),
    ],
)
def test_what_cannot_be_done_is_a_sentence(rig: Rig, action: str, wanted: dict[str, Any]) -> None:
    with RigConsole(rig) as console, pytest.raises((RigError, ConfigurationError), match=r"\w+ \w+"):
        console.act(action, wanted)


def test_beside_calibrate_one_looks_on_and_cannot_act(rig: Rig) -> None:
    log = CaptureLog(5)
    log.collected(2, 5)
    with RigConsole(rig, log) as console:
        state = console.state()
        assert (state["orders"], state["session"]["phase"], state["session"]["sets"]) == (
            False,
            Phase.COLLECTING,
            2,
        )
        with pytest.raises(RigError, match="only look on"):
            console.act("start-calibration", {})


def terminal() -> Console:
    return Console(record=True, width=200)


def test_a_live_rigs_console_goes_by_the_calibration_of_last_time(tmp_path: Path) -> None:
    calibration_of(ring_poses(2)).save(tmp_path / "calibration.json")
    console = CONSOLE.model_copy(update={"folder": tmp_path})
    settings = RigSettings(listen="127.0.0.1:0", insecure=True, announce=False, console=console)
    screen = terminal()
    with open_rig(settings, Origin(), screen) as rig:
        assert rig.calibration is not None
        assert len(rig.calibration.poses) == 2
    assert "console at http://127.0.0.1:" in screen.export_text()
    (tmp_path / "calibration.json").write_text("{")
    with (
        pytest.raises(ConfigurationError, match=r"console\.folder"),
        open_rig(settings, Origin(), terminal()),
    ):
        pass


def test_a_calibration_that_is_watched_over_stays_in_force(tmp_path: Path) -> None:
    calibration_of(ring_poses(2)).save(tmp_path / "calibration.json")
    calibration_of(ring_poses(3)).save(tmp_path / "watched.json")
    settings = RigSettings(
        listen="127.0.0.1:0",
        insecure=True,
        announce=False,
        console=CONSOLE.model_copy(update={"folder": tmp_path}),
        watch=WatchSettings(calibration=tmp_path / "watched.json"),
    )
    with open_rig(settings, Origin(), terminal()) as rig:
        assert rig.calibration is not None
        assert len(rig.calibration.poses) == 3


def test_without_a_console_none_is_opened() -> None:
    screen = terminal()
    settings = RigSettings(listen="127.0.0.1:0", insecure=True, announce=False)
    with open_rig(settings, Origin(), screen):
        assert screen.export_text() == ""
