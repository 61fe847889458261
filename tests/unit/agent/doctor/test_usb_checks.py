"""What the doctor says of Kinects on a bus of fake pyusb devices."""

from pathlib import Path
from typing import Any

import pytest
import usb.util

from rig_agent.config import AgentSettings
from rig_agent.doctor.finding import Check, Finding, Status
from rig_agent.doctor.machine import Machine
from rig_agent.doctor.usb import usb as look
from rig_agent.sources.base import SourceLost
from rig_agent.sources.freenect import FreenectSettings
from rig_protocol.troubleshooting import Topic
from support.pi_tree import AUDIO, AUDIO_K4W, CAMERA, CAMERA_K4W, FULL_SPEED, PiTree, device, kinect_1414


@pytest.fixture(autouse=True)
def _no_real_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(usb.util, "dispose_resources", lambda _device: None)


@pytest.fixture
def pi(tmp_path: Path) -> PiTree:
    return PiTree(tmp_path / "root")


def findings(machine: Machine, **freenect: Any) -> dict[Check, Finding]:
    settings = AgentSettings(freenect=FreenectSettings(**freenect))
    return {finding.check: finding for finding in look(machine, settings)}


def test_a_healthy_kinect_has_nothing_to_mend(pi: PiTree) -> None:
    found = findings(pi.machine())
    assert {finding.status for finding in found.values()} == {Status.OK}
    assert set(found) == {
        Check.KINECT,
        Check.FUNCTIONS,
        Check.SPEED,
        Check.CONTROLLER,
        Check.PERMISSION,
        Check.AUTOSUSPEND,
    }


@pytest.mark.parametrize("devices", [[], kinect_1414()[1:]], ids=["no Kinect", "no 12-V supply"])
def test_no_camera_is_a_matter_of_hardware(pi: PiTree, devices: list[Any]) -> None:
    finding = findings(pi.machine(usb_devices=lambda: devices))[Check.KINECT]
    assert (finding.status, finding.hardware, finding.topic) == (Status.FAILED, True, Topic.NO_KINECT)
    assert ("12-V supply is missing" in finding.text) == bool(devices)


def test_each_function_that_is_missing_is_named(pi: PiTree) -> None:
    camera = kinect_1414()[:1]
    elsewhere = [device(AUDIO, (2, 3))]  # belongs to another Kinect
    finding = findings(pi.machine(usb_devices=lambda: [*camera, *elsewhere]))[Check.FUNCTIONS]
    assert (finding.status, finding.hardware) == (Status.WARNING, True)
    assert "no audio and no motor" in finding.text


def test_a_later_model_has_no_motor_of_its_own_and_wants_firmware_for_led_and_tilt(pi: PiTree) -> None:
    kinect = [device(CAMERA_K4W, (1, 1), 0x0200), device(AUDIO_K4W, (1, 3), 0x0200)]
    machine = pi.machine(usb_devices=lambda: kinect)
    found = findings(machine)
    assert found[Check.FUNCTIONS].status == Status.OK
    assert found[Check.FIRMWARE].status == Status.SKIPPED
    assert "sudo install" in str(found[Check.FIRMWARE].mend)
    pi.write("/usr/share/libfreenect/audios.bin", "")
    not_loaded = findings(machine)[Check.FIRMWARE]
    assert (not_loaded.status, "is not loaded" in not_loaded.text) == (Status.SKIPPED, True)


def test_firmware_that_runs_is_told_from_firmware_that_lies_on_the_disk(pi: PiTree) -> None:
    audio = device(AUDIO, (1, 3), 0x0200, interfaces=2)  # of a 1473, whose product id stays the same
    kinect = [device(CAMERA, (1, 1), 0x0200), audio]
    assert findings(pi.machine(usb_devices=lambda: kinect))[Check.FIRMWARE].status == Status.OK


def test_a_camera_at_full_speed_carries_no_images(pi: PiTree) -> None:
    kinect = kinect_1414()
    kinect[0].speed = FULL_SPEED
    finding = findings(pi.machine(usb_devices=lambda: kinect))[Check.SPEED]
    assert (finding.status, finding.hardware) == (Status.FAILED, True)


@pytest.mark.parametrize(("other_bus", "status"), [(1, Status.FAILED), (3, Status.OK)])
def test_two_kinects_need_two_controllers(pi: PiTree, other_bus: int, status: Status) -> None:
    both = [*kinect_1414(1), *kinect_1414(2, bus=other_bus)]
    found = findings(pi.machine(usb_devices=lambda: both), port_path="1-1")
    assert found[Check.CONTROLLER].status == status


def test_two_kinects_and_a_setting_that_names_none_is_no_matter_of_hardware(pi: PiTree) -> None:
    both = [*kinect_1414(1), *kinect_1414(2)]
    finding = findings(pi.machine(usb_devices=lambda: both))[Check.KINECT]
    assert (finding.status, finding.hardware) == (Status.FAILED, False)
    assert "`serial` or `port_path`" in finding.text


@pytest.mark.parametrize(
    ("topic", "agent_runs", "status", "mend"),
    [
        (Topic.NO_PERMISSION, False, Status.FAILED, "udevadm trigger"),
        (Topic.KINECT_IN_USE, False, Status.FAILED, "rmmod gspca_kinect"),
        (Topic.KINECT_IN_USE, True, Status.OK, None),
        (Topic.NO_KINECT, False, Status.FAILED, "dmesg"),
    ],
)
def test_a_camera_that_cannot_be_opened_says_why(
    pi: PiTree, topic: Topic, agent_runs: bool, status: Status, mend: str | None
) -> None:
    def refuse(_camera: Any) -> None:
        raise SourceLost("it may not be opened", topic)

    if agent_runs:
        pi.write("/proc/78/cmdline", "python3\0/opt/kinect-rig/bin/rig-agent\0")
    finding = findings(pi.machine(check_access=refuse))[Check.PERMISSION]
    assert finding.status == status
    assert finding.mend is None if mend is None else mend in str(finding.mend)


def test_a_motor_that_this_user_may_not_open_is_a_warning(pi: PiTree) -> None:
    pi.write("/dev/bus/usb/001/012", "")  # the motor's node
    machine = pi.machine(may_open=lambda node: node.name != "012")
    finding = findings(machine)[Check.PERMISSION]
    assert (finding.status, "/dev/bus/usb/001/012" in finding.text) == (Status.WARNING, True)


def test_autosuspend_names_the_file_that_ends_it(pi: PiTree) -> None:
    pi.write("/sys/bus/usb/devices/1-1.1/power/control", "auto")
    finding = findings(pi.machine())[Check.AUTOSUSPEND]
    assert finding.mend == "echo on | sudo tee /sys/bus/usb/devices/1-1.1/power/control"
