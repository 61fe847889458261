"""Rules of an agent's take: every frame of the source, bit for bit, whatever network and disk do."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from rig_agent import agent as agent_module
from rig_agent.agent import Agent
from rig_agent.config import AgentSettings, load_agent_settings
from rig_agent.health import gauges
from rig_protocol.codecs import codec_by_name
from rig_protocol.decoding import decode_frame
from rig_protocol.errors import ConfigurationError
from rig_protocol.events import CameraJoined, FrameReceived
from rig_protocol.frames import EncodedFrame
from rig_protocol.messages import StreamChoice
from rig_protocol.recording import MANIFEST, Recording, recover
from rig_protocol.recording_format import AGENT, ClockReading, DroppedFrames
from support.loopback_server import LoopbackServer
from support.small_source import SmallSource, await_true, make_frame, running

JPEG, DISPARITY = codec_by_name("bgr-jpeg").id, codec_by_name("disparity-lossless").id
THIN = StreamChoice(JPEG, DISPARITY, fps=5.0, slot=0, slots=1, step_ns=1_000_000, spread=0.8)
"""One frame of twenty, and colour as JPEG."""


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine of tests is no busy encoder; where one is meant, the test says so."""
    monkeypatch.setattr(agent_module, "_RECORDED_QUEUE_FRAMES", 10_000)


def settings_for(path: Path, server: LoopbackServer | None = None, **changes: object) -> AgentSettings:
    address = "none" if server is None else "{}:{}".format(*server.address)
    values = {"server": address, "camera": 5, "record": {"path": path, **changes}}
    return AgentSettings.model_validate(values)


def frames_of(take: Path) -> list[EncodedFrame]:
    return [entry for entry in Recording(take).entries() if isinstance(entry, EncodedFrame)]


def is_whole(frames: list[EncodedFrame]) -> bool:
    """Every frame of the source from the first on, bit for bit."""
    return all(same_images(frame, number) for number, frame in enumerate(frames))


def same_images(frame: EncodedFrame, number: int) -> bool:
    decoded, sent = decode_frame(frame), make_frame(number)
    images = np.array_equal(decoded.bayer, sent.bayer) and np.array_equal(decoded.raw, sent.raw)
    return images and (frame.camera_id, frame.sequence) == (5, number)


def recorded(agent: Agent) -> int:
    status = agent.totals.recording
    assert status is not None
    return status.frames


def test_the_take_is_whole_though_the_network_carries_one_frame_in_twenty(tmp_path: Path) -> None:
    take = tmp_path / "take.mcap"
    with LoopbackServer() as server, running(settings_for(take, server), SmallSource) as agent:
        server.wait_for(CameraJoined)
        server.plan(5, THIN)

        def thin() -> list[EncodedFrame]:
            return [f for f in server.frames() if f.color is not None and f.color.codec_id == JPEG]

        server.wait_until(lambda: thin()[3:])
        await_true(lambda: recorded(agent) > 60)
        came = [frame.sequence for frame in thin()]
    frames = frames_of(take)
    assert is_whole(frames)
    assert len(frames) > 60
    assert came[-1] - came[0] < 3 * len(came)  # what is left out on purpose is no gap in the count
    assert np.diff([f.timestamp_ns for f in thin()]).mean() > 100_000_000
    readings = [entry for entry in Recording(take).entries() if isinstance(entry, ClockReading)]
    (tie,) = {tie.clock for reading in readings for tie in reading.ties if tie.clock != "utc"}
    assert tie == "rig:of-the-test"
    for reading in readings:  # both ends are on this machine: the truth is zero
        for one in reading.ties:
            if one.clock == tie:
                assert abs(one.offset_ns) <= 5 * one.uncertainty_ns


def test_without_a_server_and_a_key_it_records_all_the_same(tmp_path: Path) -> None:
    with running(settings_for(tmp_path), SmallSource, key=None) as agent:
        await_true(lambda: recorded(agent) >= 20)
        told = gauges(agent.totals)
    assert told["recording"] == 1
    assert told["not_recorded"] == 0
    (take,) = tmp_path.iterdir()  # a folder: a new file in it
    assert take.name.startswith("cam05-2")
    recording = Recording(take)
    assert not recording.torn
    assert recording.clock == AGENT
    assert recording.description.camera_ids == (5,)
    assert len(frames_of(take)) >= 20
    assert is_whole(frames_of(take))


def test_a_second_start_in_a_folder_begins_another_take(tmp_path: Path) -> None:
    for _ in range(2):
        with running(settings_for(tmp_path), SmallSource, key=None) as agent:
            await_true(lambda agent=agent: recorded(agent) >= 1)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_folder_that_is_not_there_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="mkdir -p"):
        Agent(settings_for(tmp_path / "takes"), None, SmallSource)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "take.mcap").write_bytes(b"dear")
    with pytest.raises(ConfigurationError, match="exists"):
        Agent(settings_for(tmp_path / "take.mcap"), None, SmallSource)


def test_a_camera_without_a_slot_is_refused_in_words(tmp_path: Path) -> None:
    settings = AgentSettings.model_validate({"server": "none", "record": {"path": tmp_path}})
    with pytest.raises(ConfigurationError, match="give --camera"):
        Agent(settings, None, SmallSource).run()


def test_a_busy_encoder_loses_frames_that_the_take_tells_and_never_holds_up_capture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    release, encode = threading.Event(), agent_module.encode_frame

    def slow(*words: object) -> EncodedFrame:
        assert release.wait(30)
        return encode(*words)  # type: ignore[arg-type]

    monkeypatch.setattr(agent_module, "encode_frame", slow)
    monkeypatch.setattr(agent_module, "_RECORDED_QUEUE_FRAMES", 16)
    take = tmp_path / "take.mcap"
    with running(settings_for(take), SmallSource, key=None) as agent:
        await_true(lambda: agent.totals.captured >= 30)
        release.set()
        await_true(lambda: recorded(agent) >= 20)
    entries = list(Recording(take).entries())
    dropped = [entry for entry in entries if isinstance(entry, DroppedFrames)]
    frames = [entry for entry in entries if isinstance(entry, EncodedFrame)]
    numbers = [frame.sequence for frame in frames]
    assert sum(one.count for one in dropped) == numbers[-1] + 1 - len(numbers) >= 10
    assert all(same_images(frame, frame.sequence) for frame in frames)
    told = Recording(take).document(MANIFEST)["not_recorded"]["5"]["frames"]
    assert told == sum(one.count for one in dropped)


def test_a_full_disk_ends_the_take_in_order_and_frames_go_on_to_the_server(tmp_path: Path) -> None:
    take = tmp_path / "take.mcap"
    settings = settings_for(take, server := LoopbackServer(), keep_free_mib=1 << 30)
    with server, running(settings, SmallSource) as agent:
        await_true(lambda: gauges(agent.totals)["recording"] == 0)
        server.wait_for(FrameReceived, len(server.frames()) + 5)
        line_of_health = agent.totals.recording
    assert line_of_health is not None
    assert "MiB of the disk are free" in str(line_of_health.ended)
    assert not Recording(take).torn


def test_where_it_does_not_stream_the_server_hears_of_it_and_gets_no_frames(tmp_path: Path) -> None:
    take = tmp_path / "take.mcap"
    settings = settings_for(take, server := LoopbackServer(), stream=False)
    with server, running(settings, SmallSource) as agent:
        hello = server.wait_for(CameraJoined).hello
        server.plan(5, StreamChoice(None, None, 100.0, 0, 1, 1_000_000, 0.8))
        await_true(lambda: agent._take is not None and agent._take.rig_tie is not None)
        await_true(lambda: recorded(agent) > 100)
        assert server.frames() == []
    assert (hello.color_codecs, hello.depth_codecs) == ((), ())
    assert is_whole(frames_of(take))
    assert any(isinstance(entry, ClockReading) for entry in Recording(take).entries())


KILLED = """
import sys
from pathlib import Path
import rig_agent.agent
from rig_agent.agent import Agent
from rig_agent.config import AgentSettings
from support.small_source import SmallSource
rig_agent.agent._RECORDED_QUEUE_FRAMES = 10_000
settings = {"server": "none", "camera": 5, "record": {"path": sys.argv[1]}}
Agent(AgentSettings.model_validate(settings), None, SmallSource).run()
"""


def test_a_kill_loses_at_most_the_last_second_and_recover_mends_the_take(tmp_path: Path) -> None:
    take = tmp_path / "take.mcap"
    paths = os.pathsep.join(path for path in sys.path if path)
    environment = {**os.environ, "PYTHONPATH": paths}
    with subprocess.Popen([sys.executable, "-c", KILLED, str(take)], env=environment) as child:
        await_true(lambda: take.exists() and take.stat().st_size > 100_000)
        killed_ns = time.monotonic_ns()
        child.send_signal(signal.SIGKILL)
    before = frames_of(take)
    assert Recording(take).torn == (take,)
    assert is_whole(before)
    assert killed_ns - before[-1].timestamp_ns < 1_000_000_000
    recover(take)
    assert not Recording(take).torn
    assert frames_of(take) == before
    assert Recording(take).clock == AGENT
    assert Recording(take).description.camera_ids == (5,)


def test_nothing_to_stream_to_and_nothing_to_record_is_a_wrong_setting() -> None:
    with pytest.raises(ConfigurationError, match="give --record"):
        load_agent_settings(None, {"server": "none"})
