"""The doctor's handshake with a real server on loopback."""

import socket
from pathlib import Path

import pytest

from rig_agent.config import AgentSettings
from rig_agent.doctor import server as module
from rig_agent.doctor.finding import Check, Finding, Status
from rig_agent.doctor.server import server
from rig_agent.sources.base import SourceDescription
from rig_protocol.camera import CameraModel
from rig_protocol.events import CameraJoined, CameraLeft
from rig_protocol.key_file import write_key
from rig_protocol.rig_key import RigKey
from rig_protocol.roster import Roster, Slot
from rig_protocol.troubleshooting import Topic
from support.loopback_server import LoopbackServer
from support.pi_tree import PiTree
from support.small_agent import SmallAgent

RIG_KEY = RigKey(bytes(range(32)))
OWN = SourceDescription("A00366A1", "1-1.1", CameraModel(), 30.0, "bayer", "raw")


@pytest.fixture
def pi(tmp_path: Path) -> PiTree:
    return PiTree(tmp_path / "root")


@pytest.fixture
def key_file(tmp_path: Path) -> Path:
    write_key(tmp_path / "rig.key", RIG_KEY)
    return tmp_path / "rig.key"


def answer(pi: PiTree, settings: AgentSettings, description: SourceDescription | None = OWN) -> Finding:
    return {finding.check: finding for finding in server(pi.machine(), settings, description)}[Check.SERVER]


def at(rig: LoopbackServer) -> str:
    return f"{rig.address[0]}:{rig.address[1]}"


def test_a_server_that_welcomes_is_told_goodbye_at_once(pi: PiTree, key_file: Path) -> None:
    with LoopbackServer(rig_key=RIG_KEY) as rig:
        finding = answer(pi, AgentSettings(server=at(rig), camera=3, key_file=key_file))
        assert (finding.status, "as 3" in finding.text) == (Status.OK, True)
        rig.wait_for(CameraLeft)


def test_another_key_is_refused_with_the_servers_reason(pi: PiTree, key_file: Path) -> None:
    with LoopbackServer(rig_key=RigKey(bytes(32))) as rig:
        finding = answer(pi, AgentSettings(server=at(rig), camera=3, key_file=key_file))
    assert (finding.status, finding.topic) == (Status.FAILED, Topic.AGENT_REFUSED)
    assert "WRONG_KEY" in finding.text
    assert "rig.key /etc/kinect-rig/rig.key" in str(finding.mend)


def test_a_camera_that_the_rig_does_not_list_is_refused(pi: PiTree) -> None:
    roster = Roster((Slot(0, "cam00", "A00366A0", None),), open=False)
    with LoopbackServer(roster=roster) as rig:
        finding = answer(pi, AgentSettings(server=at(rig), insecure=True))
    assert (finding.status, "UNKNOWN_CAMERA" in finding.text) == (Status.FAILED, True)


def test_an_agent_that_runs_here_keeps_its_session(pi: PiTree) -> None:
    """Its own serial number in the doctor's hello would end it."""
    pi.write("/proc/78/cmdline", "python3\0/opt/kinect-rig/bin/rig-agent\0")
    own = SourceDescription("S3", None, CameraModel(), 30.0, "bayer", "raw")
    with LoopbackServer() as rig, SmallAgent(3, rig.address):
        rig.wait_for(CameraJoined)
        finding = answer(pi, AgentSettings(server=at(rig), camera=3, insecure=True), own)
        assert finding.status == Status.OK, finding.text
        assert not any(isinstance(event, CameraLeft) for event in rig.events)


def test_a_slot_that_another_machine_holds_is_refused_with_its_address(pi: PiTree) -> None:
    with LoopbackServer() as rig, SmallAgent(3, rig.address):
        rig.wait_for(CameraJoined)
        finding = answer(pi, AgentSettings(server=at(rig), camera=3, insecure=True))
    assert (finding.status, finding.topic) == (Status.FAILED, Topic.AGENT_REFUSED)
    assert "DUPLICATE_SLOT" in finding.text
    assert "127.0.0.1" in finding.text


def test_a_port_where_nobody_listens_is_told_from_a_machine_that_is_silent(
    pi: PiTree, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_LIMIT_NS", 300_000_000)
    with LoopbackServer() as rig:
        settings = AgentSettings(server=at(rig), insecure=True)
    closed = answer(pi, settings)
    assert (closed.status, "does not run" in closed.text) == (Status.FAILED, True)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as deaf:
        deaf.bind(("127.0.0.1", 0))
        silent = answer(pi, AgentSettings(server=f"127.0.0.1:{deaf.getsockname()[1]}", insecure=True))
    assert (silent.status, "is silent" in silent.text) == (Status.FAILED, True)
    assert closed.topic == silent.topic == Topic.SERVER_SILENT


def test_a_key_that_others_may_read_fails_before_anything_is_sent(pi: PiTree, key_file: Path) -> None:
    key_file.chmod(0o644)
    (finding,) = server(pi.machine(), AgentSettings(key_file=key_file), OWN)
    assert (finding.check, finding.status, finding.topic) == (Check.KEY, Status.FAILED, Topic.RIG_KEY)
    assert str(key_file) in str(finding.mend)
