"""Rules of the whole agent over loopback: it outlives the server, the device and bad news."""

import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rig_agent.agent import Agent, _Hang
from rig_agent.config import AgentSettings, PacingSettings
from rig_agent.sources.base import (
    SourceLost,
)
from rig_protocol.camera import CameraModel, Intrinsics
from rig_protocol.codecs import codec
from rig_protocol.errors import DataError
from rig_protocol.events import CameraJoined, CameraLeft, FrameReceived, Outcome
from rig_protocol.frames import RgbdFrame
from rig_protocol.rig_folder import CameraEntry, RigDescription, write_rig_folder
from rig_protocol.rig_key import RigKey
from rig_protocol.roster import Roster, Slot
from support.loopback_server import LoopbackServer
from support.small_source import SmallSource, await_true, make_frame, running


def make_settings(server: LoopbackServer, **changes: object) -> AgentSettings:
    host, port = server.address
    return AgentSettings.model_validate({"server": f"{host}:{port}", "camera": 5, **changes})


@pytest.fixture
def server() -> Iterator[LoopbackServer]:
    with LoopbackServer() as server:
        yield server


class SwitchedSource(SmallSource):
    """Delivers infrared images instead of Bayer from the fourth frame to the seventh."""

    def read(self, timeout_s: float) -> RgbdFrame | None:
        frame = super().read(timeout_s)
        if frame is not None and 3 <= frame.sequence < 7:
            return replace(frame, bayer=None, color=np.zeros((48, 64), np.uint8))
        return frame


def test_images_of_another_kind_than_agreed_are_left_out_and_end_no_agent(server: LoopbackServer) -> None:
    with running(make_settings(server), SwitchedSource) as agent:
        server.wait_for(FrameReceived, 5)
        await_true(lambda: agent.totals.captured > 12)
        server.wait_for(FrameReceived, 8)
    assert all(frame.color is not None for frame in server.frames())


def test_frames_arrive_bit_exact_under_the_agents_slot(server: LoopbackServer) -> None:
    with running(make_settings(server), SmallSource):
        server.wait_for(FrameReceived, 3)
    frame = server.frames()[2]
    assert (frame.camera_id, frame.damaged) == (5, False)
    assert frame.color is not None
    assert frame.depth is not None
    sent = make_frame(frame.sequence)
    np.testing.assert_array_equal(codec(frame.color.codec_id).decode(frame.color.data), sent.bayer)
    np.testing.assert_array_equal(codec(frame.depth.codec_id).decode(frame.depth.data), sent.raw)


def test_the_hello_says_who_the_camera_is(server: LoopbackServer) -> None:
    with running(make_settings(server, name="door", fps=10.0), SmallSource):
        hello = server.wait_for(CameraJoined).hello
    assert (hello.name, hello.camera_id, hello.serial, hello.fps) == ("door", 5, "A1", 10.0)
    assert hello.software.startswith("kinect-rig ")


@pytest.mark.parametrize(
    ("color", "depth", "names"),
    [
        ("lossless", "lossless", ("bayer-lossless", "disparity-lossless")),
        ("jpeg", "raw", ("bgr-jpeg", "disparity-uncompressed")),
        ("raw", "lossless", ("bayer-uncompressed", "disparity-lossless")),
    ],
)
def test_images_travel_as_the_settings_say(
    server: LoopbackServer, color: str, depth: str, names: tuple[str, str]
) -> None:
    with running(make_settings(server, color=color, depth=depth), SmallSource):
        frame = server.wait_for(FrameReceived).frame
    assert frame.color is not None
    assert frame.depth is not None
    assert (codec(frame.color.codec_id).name, codec(frame.depth.codec_id).name) == names


def test_stopping_says_goodbye_and_closes_the_source(server: LoopbackServer) -> None:
    source = SmallSource()
    with running(make_settings(server), lambda: source):
        server.wait_for(FrameReceived)
    assert "goodbye" in server.wait_for(CameraLeft).text
    assert source.closed


@pytest.mark.parametrize("silently", [True, False])
def test_the_agent_comes_back_when_the_server_restarts(server: LoopbackServer, silently: bool) -> None:
    with running(make_settings(server), SmallSource) as agent:
        server.wait_for(FrameReceived)
        server.stop(silently=silently)
        with LoopbackServer(server.address) as restarted:
            restarted.wait_for(FrameReceived, 3)
            assert restarted.wait_for(CameraJoined).camera_id == 5
            assert agent.totals.connections == 2


def test_the_agent_may_start_before_the_server() -> None:
    with LoopbackServer() as first:
        address = first.address
    with running(AgentSettings(server=f"127.0.0.1:{address[1]}", camera=5), SmallSource) as agent:
        await_true(lambda: agent.totals.unheard > 0)
        with LoopbackServer(address) as server:
            server.wait_for(FrameReceived)


def test_a_lost_device_is_reopened_and_the_session_goes_on(server: LoopbackServer) -> None:
    reads = iter(range(10**9))

    def lose_once() -> None:
        if next(reads) == 10:
            raise SourceLost("unplugged")

    with running(make_settings(server), lambda: SmallSource(trouble=lose_once)) as agent:
        server.wait_for(FrameReceived, 20)
        assert (agent.totals.source_losses, agent.totals.connections) == (1, 1)
    sequences = [frame.sequence for frame in server.frames()]
    assert sequences == sorted(set(sequences))


def test_another_device_in_its_place_says_hello_anew(server: LoopbackServer) -> None:
    serials = iter(["A1", "B2"])
    reads = iter(range(10**9))

    def lose_once() -> None:
        if next(reads) == 10:
            raise SourceLost("unplugged")

    with running(make_settings(server), lambda: SmallSource(next(serials), trouble=lose_once)):
        assert server.wait_for(CameraJoined, 2).hello.serial == "B2"


def test_frames_beyond_what_can_be_sent_are_dropped_and_counted(server: LoopbackServer) -> None:
    settings = make_settings(server, pacing=PacingSettings(spread=1.0, burst=1))
    with running(settings, lambda: SmallSource(fps=100_000.0)) as agent:
        server.wait_for(FrameReceived, 5)
        await_true(lambda: agent.totals.dropped > 20)
    totals = agent.totals
    in_flight = totals.captured - totals.sent - totals.dropped - totals.unheard
    assert 0 <= in_flight <= 2 + 2 + 2  # two queues and the two frames of the pacer


def test_what_no_retry_cures_ends_the_agent_with_a_goodbye(server: LoopbackServer) -> None:
    reads = iter(range(10**9))

    def break_later() -> None:
        if next(reads) == 30:
            raise DataError("color_003.png is torn")

    agent = Agent(make_settings(server), RigKey.INSECURE, lambda: SmallSource(trouble=break_later))
    with pytest.raises(DataError, match=r"color_003.png is torn"):
        agent.run()
    assert "goodbye" in server.wait_for(CameraLeft).text


def test_a_refusal_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    roster = Roster((Slot(0, "cam00"),))
    with (
        caplog.at_level(logging.INFO),
        LoopbackServer(roster=roster) as server,
        running(make_settings(server), SmallSource),
    ):
        server.wait_until(lambda: [None] if server.refusals >= 2 else [])
    refusals = [message for message in caplog.messages if "UNKNOWN_CAMERA" in message]
    assert len(refusals) == 1
    assert "not in the rig" in refusals[0]


@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_program_with_a_goodbye_and_status_0(
    server: LoopbackServer, tmp_path: Path, ending: signal.Signals
) -> None:
    model = CameraModel(color=Intrinsics(50, 50, 32, 24, 64, 48), source="file")
    image = np.zeros((48, 64), np.uint8)
    frame = RgbdFrame(3, 0, 0, color=image, raw=image.astype(np.uint16))
    write_rig_folder(tmp_path, RigDescription((CameraEntry(3, "cam03", model),)), [frame])
    words = ["--source", "folder", "--path", str(tmp_path), "--camera", "3", "--insecure"]
    program = subprocess.Popen(
        [sys.executable, "-m", "rig_agent.cli", *words, "--server", f"127.0.0.1:{server.address[1]}"],
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env={name: value for name, value in os.environ.items() if not name.startswith("RIG_AGENT_")},
    )
    with program:
        server.wait_for(FrameReceived, 3)
        program.send_signal(ending)
        _, log = program.communicate(timeout=20)
    assert program.returncode == 0, log
    assert "goodbye" in server.wait_for(CameraLeft).text
    assert "Traceback" not in log


def test_a_driver_hangs_when_this_program_ran_on_for_a_minute_without_a_sign_of_it() -> None:
    hang, second_ns = _Hang(), 10**9
    turns = [hang.lasts(5, k * second_ns // 5) for k in range(310)]
    assert turns.index(True) == pytest.approx(301, abs=2)
    assert not hang.lasts(6, 62 * second_ns)  # a sign


@pytest.mark.parametrize("jump_ns", [3_600 * 10**9, -3_600 * 10**9])
def test_neither_a_clock_that_jumps_an_hour_nor_a_stopped_program_is_a_hang(jump_ns: int) -> None:
    hang = _Hang()
    assert not hang.lasts(1, 10**13)
    assert not hang.lasts(1, 10**13 + jump_ns)


def test_a_control_of_the_camera_is_done_by_it_and_answered() -> None:
    source = SmallSource()
    with LoopbackServer() as server, running(make_settings(server), lambda: source):
        server.wait_for(FrameReceived)
        answer = server.control(5, "tilt_deg", 4.0)
        assert (answer.outcome, answer.text) == (Outcome.DONE, "tilt_deg is 4.0")
        refused = server.control(5, "sing", "louder")
    assert refused.outcome is Outcome.REFUSED
    assert "it has tilt_deg" in refused.text
    assert "log_level" in refused.text
    assert source.done == [("tilt_deg", 4.0)]


def test_a_control_that_the_device_dies_of_is_refused_and_the_source_opened_again() -> None:
    opened: list[SmallSource] = []

    def open_source() -> SmallSource:
        opened.append(SmallSource())
        return opened[-1]

    with LoopbackServer() as server, running(make_settings(server), open_source):
        server.wait_for(FrameReceived)
        answer = server.control(5, "die", True)
        assert (answer.outcome, answer.text) == (Outcome.REFUSED, "the device died of it")
        seen = len(server.frames())
        server.wait_for(FrameReceived, seen + 5)
    assert len(opened) == 2


def test_the_source_is_opened_again_where_the_operator_wants_it_whatever_source_it_is() -> None:
    opened: list[SmallSource] = []

    def open_source() -> SmallSource:
        opened.append(SmallSource())
        return opened[-1]

    with LoopbackServer() as server, running(make_settings(server), open_source) as agent:
        server.wait_for(FrameReceived)
        assert server.control(5, "reopen_source", True).outcome is Outcome.DONE
        server.wait_until(lambda: opened[1:])
        assert opened[0].closed
        assert agent.totals.source_losses == 0


def test_the_log_level_is_set_and_a_word_that_is_none_refused() -> None:
    root = logging.getLogger()
    before = root.level
    try:
        with LoopbackServer() as server, running(make_settings(server), SmallSource):
            server.wait_for(FrameReceived)
            assert server.control(5, "log_level", "debug").outcome is Outcome.DONE
            assert root.level == logging.DEBUG
            assert server.control(5, "log_level", "loud").outcome is Outcome.REFUSED
    finally:
        root.setLevel(before)


def test_depth_that_a_server_switched_off_comes_on_again_when_that_server_has_gone() -> None:
    source = SmallSource()
    with LoopbackServer() as server, running(make_settings(server), lambda: source):
        server.wait_for(FrameReceived)
        server.control(5, "depth", False)
        server.control(5, "led", "off")  # not a stream: stays
        server.stop()
        await_true(lambda: ("depth", True) in source.done)
    assert source.done == [("depth", False), ("led", "off"), ("depth", True)]


def test_an_agent_that_is_told_to_restart_answers_first_and_ends_for_it() -> None:
    with LoopbackServer() as server:
        agent = Agent(make_settings(server), RigKey.INSECURE, SmallSource)
        thread = threading.Thread(target=agent.run)
        thread.start()
        server.wait_for(FrameReceived)
        assert server.control(5, "restart_agent", True).outcome is Outcome.DONE
        thread.join(20.0)
        assert not thread.is_alive()
        assert agent.restarts
        server.wait_for(CameraLeft)


def test_the_program_that_is_told_to_restart_starts_anew_in_the_same_process(tmp_path: Path) -> None:
    with LoopbackServer() as server:
        host, port = server.address
        words = [
            "--insecure",
            "--source",
            "synthetic",
            "--camera",
            "0",
            "--server",
            f"{host}:{port}",
            "--fps",
            "5",
        ]
        config = tmp_path / "agent.toml"
        config.touch()
        command = [sys.executable, "-m", "rig_agent.cli", "--config", str(config), *words]
        with subprocess.Popen(command, stderr=subprocess.DEVNULL) as program:
            try:
                server.wait_for(CameraJoined)
                server.control(0, "restart_agent", True)
                server.wait_for(CameraJoined, 2)
                assert program.poll() is None
            finally:
                program.terminate()
