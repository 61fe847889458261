"""Real agents stream over loopback UDP to a real server: what happens when something goes wrong."""

import socket
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from rig_protocol.datagram import MessageType, pack_prefix, parse_prefix
from rig_protocol.frames import RgbdFrame
from rig_protocol.key_file import write_key
from rig_protocol.rig_key import RigKey
from rig_protocol.testing import Faults
from rig_server import Rig
from support.garbage import send_garbage
from support.rig_processes import (
    LOOPBACK,
    AgentProcess,
    any_set,
    folder_agents,
    free_port,
    holds_only_written_images,
    is_complete,
    server_settings,
    wait_for_set,
    write_small_rig,
)
from support.udp_relay import UdpRelay

FEW = range(3)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[RgbdFrame]]:
    """A rig folder of twelve cameras and what is in it."""
    folder = tmp_path_factory.mktemp("rig")
    return folder, write_small_rig(folder)


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def few_agents(
    written: tuple[Path, list[RgbdFrame]], tmp_path: Path, port: int
) -> Iterator[dict[int, AgentProcess]]:
    with folder_agents(written[0], tmp_path, port, FEW) as agents:
        yield agents


def test_twelve_agents_deliver_complete_bit_exact_sets(
    written: tuple[Path, list[RgbdFrame]], tmp_path: Path, port: int
) -> None:
    folder, frames = written
    with (
        Rig.live(server_settings(port, 12)) as rig,
        folder_agents(folder, tmp_path, port, range(12)),
    ):
        rig.wait_for_cameras(60)
        for _ in range(10):
            panorama = wait_for_set(rig, is_complete)
            assert holds_only_written_images(panorama, frames)
            assert panorama.spread_ns < 100_000_000  # one interval at 10 frames a second


def test_loss_and_reordering_cost_no_frame(
    written: tuple[Path, list[RgbdFrame]], tmp_path: Path, port: int
) -> None:
    """2 % of the datagrams lost, both ways, 5 % late by more than a frame's sending time, 1 % twice."""
    folder, frames = written
    faults = Faults(drop=0.02, reorder=0.05, reorder_ns=20_000_000, duplicate=0.01)
    with (
        Rig.live(server_settings(port, len(FEW))) as rig,
        UdpRelay((LOOPBACK, port), faults) as relay,
        folder_agents(folder, tmp_path, relay.port, FEW),
    ):
        wait_for_set(rig, is_complete)
        lost_before = sum(camera.lost for camera in rig.status().cameras)
        seen = [wait_for_set(rig, is_complete) for _ in range(40)]
        status = rig.status()
    assert all(holds_only_written_images(panorama, frames) for panorama in seen)
    assert sum(camera.lost for camera in status.cameras) == lost_before
    assert relay.done("lost") > 0
    assert relay.done("reordered") > 0


def test_altered_datagrams_cost_frames_but_never_a_wrong_pixel(
    written: tuple[Path, list[RgbdFrame]], tmp_path: Path, port: int
) -> None:
    """0.5 % of the datagrams altered on top, with a UDP checksum that fits."""
    folder, frames = written
    faults = Faults(drop=0.02, duplicate=0.01, corrupt=0.005)
    with (
        Rig.live(server_settings(port, len(FEW))) as rig,
        UdpRelay((LOOPBACK, port), faults) as relay,
        folder_agents(folder, tmp_path, relay.port, FEW),
    ):
        rig.wait_for_cameras(60)
        seen = [wait_for_set(rig, any_set) for _ in range(40)]
        status = rig.status()
    assert all(holds_only_written_images(panorama, frames) for panorama in seen)
    assert any(panorama.complete for panorama in seen)
    assert any(panorama.missing for panorama in seen)
    assert sum(camera.corrupt for camera in status.cameras) > 0
    assert sum(camera.duplicate for camera in status.cameras) > 0


def test_an_agent_with_another_key_is_refused_readably_and_the_rig_goes_on(
    written: tuple[Path, list[RgbdFrame]], tmp_path: Path, port: int
) -> None:
    folder, _ = written
    write_key(tmp_path / "other.key", RigKey(bytes(32)))
    options = ["--source", "folder", "--path", folder, "--fps", 10, "--camera", 1]
    with (
        Rig.live(server_settings(port, 2)) as rig,
        folder_agents(folder, tmp_path, port, [0]),
    ):
        stranger = AgentProcess(
            tmp_path / "stranger.log", port, [*options, "--key-file", tmp_path / "other.key"]
        ).start()
        try:
            stranger.wait_for_log(r"refuses this camera \(WRONG_KEY\): .*copy the server's key file")
            wait_for_set(rig, lambda panorama: panorama.frames[0] is not None)
        finally:
            stranger.kill()
        assert [camera.connected for camera in rig.status().cameras if camera.camera_id == 1] in ([], [False])


def test_a_killed_agent_is_named_as_missing_and_comes_back(
    few_agents: dict[int, AgentProcess], port: int
) -> None:
    with Rig.live(server_settings(port, len(FEW))) as rig:
        wait_for_set(rig, is_complete)
        few_agents[1].kill()
        wait_for_set(rig, lambda panorama: panorama.missing == (1,))
        few_agents[1].start()
        wait_for_set(rig, is_complete)


def test_agents_find_a_restarted_server_by_themselves(few_agents: dict[int, AgentProcess], port: int) -> None:
    with Rig.live(server_settings(port, len(FEW))) as rig:
        wait_for_set(rig, is_complete)
    with Rig.live(server_settings(port, len(FEW))) as rig:
        wait_for_set(rig, is_complete, timeout_s=10)
    assert all(agent.stop() == 0 for agent in few_agents.values())


def test_an_agent_that_stops_says_goodbye(few_agents: dict[int, AgentProcess], port: int) -> None:
    with Rig.live(server_settings(port, len(FEW))) as rig:
        wait_for_set(rig, is_complete)
        assert few_agents[2].stop() == 0
        # Well before the two seconds of silence that would end the session of a dead agent.
        wait_for_set(rig, lambda panorama: panorama.missing == (2,), timeout_s=5)
        assert [camera.connected for camera in rig.status().cameras] == [True, True, False]


@pytest.mark.usefixtures("few_agents")
def test_garbage_and_other_versions_do_not_touch_the_stream(port: int) -> None:
    with Rig.live(server_settings(port, len(FEW))) as rig:
        wait_for_set(rig, is_complete)
        lost_before = sum(camera.lost for camera in rig.status().cameras)
        fragment = pack_prefix(MessageType.FRAGMENT, 0, 99)
        kinds = (b"KR" + bytes(range(256)) * 6, fragment + bytes(1472))
        sizes = (0, 1, 15, 16, 31, 32, 600, 1472)
        send_garbage(rig, (LOOPBACK, port), [kind[:size] for size in sizes for kind in kinds] * 100)
        for _ in range(10):
            wait_for_set(rig, is_complete)
        status = rig.status()
    assert sum(camera.lost for camera in status.cameras) == lost_before


def test_a_stranger_of_another_version_is_told_so(port: int) -> None:
    """A hello of version 9: right prefix and checksum, a body that nobody here reads."""
    body = bytes(600)
    head = b"KR" + bytes([9, MessageType.HELLO])
    nonce = (1234).to_bytes(8, "little")
    crc = zlib.crc32(head + nonce + body).to_bytes(4, "little")
    with (
        Rig.live(server_settings(port, 1)) as rig,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        stranger.settimeout(5)
        stranger.connect((LOOPBACK, port))
        stranger.send(head + crc + nonce + body)
        answer = stranger.recv(2048)
        assert rig.status().connected == 0
    prefix = parse_prefix(answer)
    assert prefix is not None
    assert (prefix.type, prefix.id) == (MessageType.REJECT, 1234)
    assert b"version 9" in answer


def test_refusals_are_readable_on_the_agent(
    written: tuple[Path, list[RgbdFrame]], tmp_path: Path, port: int
) -> None:
    """Camera 7 is not in a rig of three; a second camera 0 is one too many."""
    folder, _ = written
    options = ["--source", "folder", "--path", folder, "--fps", 10, "--camera"]
    with (
        Rig.live(server_settings(port, len(FEW))),
        folder_agents(folder, tmp_path, port, [0]) as agents,
    ):
        agents[0].wait_for_log(r"(?i)connected")
        for camera, told in ((7, r"id 7\) is not in the rig"), (0, r"(?i)slot|already")):
            other = AgentProcess(tmp_path / f"other{camera}.log", port, [*options, camera]).start()
            try:
                other.wait_for_log(r"(?i)refuses this camera")
                other.wait_for_log(told)
            finally:
                other.kill()
