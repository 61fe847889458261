"""What the doctor says of supply, processor, disk, clock, kernel and network of a Pi made of files."""

import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rig_agent.config import AgentSettings
from rig_agent.doctor.clock import clock
from rig_agent.doctor.disk import disk
from rig_agent.doctor.finding import Check, Finding, Status
from rig_agent.doctor.kernel import kernel
from rig_agent.doctor.libraries import libraries
from rig_agent.doctor.machine import Machine
from rig_agent.doctor.network import network
from rig_agent.doctor.power import power, processor
from rig_protocol.errors import ConfigurationError
from rig_protocol.system_clock import KernelClock
from support.pi_tree import PiTree

SETTINGS = AgentSettings(server="10.0.0.1")
Look = Callable[[Machine, AgentSettings], list[Finding]]
LOOKS: tuple[Look, ...] = (power, processor, disk, clock, kernel, network)


@pytest.fixture
def pi(tmp_path: Path) -> PiTree:
    return PiTree(tmp_path / "root")


def verdict(machine: Machine, look: Look, check: Check, settings: AgentSettings = SETTINGS) -> Finding:
    (finding,) = [one for one in look(machine, settings) if one.check == check]
    return finding


def test_a_pi_in_order_has_nothing_to_mend(pi: PiTree) -> None:
    found = [finding for look in LOOKS for finding in look(pi.machine(), SETTINGS)]
    assert {finding.status for finding in found} == {Status.OK}, found
    assert all(finding.mend is None and finding.topic is None for finding in found)


def test_a_root_without_files_is_skipped_over_and_breaks_nothing(tmp_path: Path) -> None:
    """As in a chroot without /proc, /sys and systemd."""
    machine = PiTree(tmp_path / "pi").machine(root=tmp_path / "empty")
    (tmp_path / "empty").mkdir()
    found = [finding for look in LOOKS for finding in look(machine, SETTINGS)]
    assert {finding.status for finding in found} <= {Status.OK, Status.SKIPPED, Status.WARNING}


@pytest.mark.parametrize(
    ("flags", "status", "told"),
    [
        ("0", Status.OK, "enough power"),
        ("50005", Status.FAILED, "voltage is too low, it is throttled now"),
        ("50000", Status.WARNING, "at times its supply's voltage is too low, it is throttled"),
        ("8", Status.FAILED, "too hot"),
        ("nonsense", Status.SKIPPED, "does not tell"),
    ],
)
def test_the_pis_flags_tell_of_a_weak_supply_now_or_before(
    pi: PiTree, flags: str, status: Status, told: str
) -> None:
    pi.write("/sys/devices/platform/soc/soc:firmware/get_throttled", flags)
    finding = verdict(pi.machine(), power, Check.POWER)
    assert finding.status == status
    assert told in finding.text
    assert finding.hardware == (status in (Status.FAILED, Status.WARNING))


def test_the_firmwares_own_tool_is_asked_where_the_kernel_does_not_tell(pi: PiTree) -> None:
    pi.remove("/sys/devices/platform/soc/soc:firmware/get_throttled")
    machine = pi.machine(command_output=lambda words: "throttled=0x1" if words[0] == "vcgencmd" else None)
    assert verdict(machine, power, Check.POWER).status == Status.FAILED


def test_a_pc_is_no_pi_and_its_supply_is_not_judged(pi: PiTree) -> None:
    pi.remove("/proc/device-tree/model")
    assert verdict(pi.machine(), power, Check.POWER).status == Status.SKIPPED


Change = tuple[str, str]


@pytest.mark.parametrize(
    ("look", "check", "change", "status", "mend"),
    [
        (processor, Check.GOVERNOR, ("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "powersave"),
         Status.WARNING, "scaling_governor"),
        (processor, Check.TEMPERATURE, ("/sys/class/thermal/thermal_zone0/temp", "81500"),
         Status.WARNING, "cool it"),
        (disk, Check.WRITABLE, ("/proc/mounts", "/dev/mmcblk0p2 / ext4 ro,noatime 0 0"),
         Status.WARNING, "remount,rw"),
        (clock, Check.CLOCK_SOURCE,
         ("/sys/devices/system/clocksource/clocksource0/current_clocksource", "jiffies"),
         Status.WARNING, "available_clocksource"),
        (kernel, Check.WEBCAM_DRIVER, ("/proc/modules", "gspca_kinect 16384 0 - Live 0x0"),
         Status.FAILED, "sudo rmmod gspca_kinect"),
        (kernel, Check.WEBCAM_DRIVER,
         ("/etc/modprobe.d/kinect-rig-blacklist.conf", "# blacklist gspca_kinect"),
         Status.WARNING, "/etc/modprobe.d/"),
        (kernel, Check.RULES, ("/etc/udev/rules.d/60-kinect-rig.rules", 'ATTR{idVendor}=="045e" 02ae'),
         Status.WARNING, "udevadm"),
        (network, Check.MTU, ("/sys/class/net/eth0/mtu", "1400"),
         Status.FAILED, "sudo ip link set eth0 mtu 1500"),
        (network, Check.LINK_SPEED, ("/sys/class/net/eth0/speed", "100"), Status.WARNING, "ethtool eth0"),
        (network, Check.LINK_SPEED, ("/sys/class/net/eth0/speed", "10"), Status.FAILED, "ethtool eth0"),
        (network, Check.LINK_SPEED, ("/sys/class/net/eth0/duplex", "half"), Status.FAILED, "ethtool eth0"),
        (network, Check.LINK_SPEED, ("/sys/class/net/eth0/speed", "-1"), Status.SKIPPED, None),
        (network, Check.BUFFERS, ("/proc/sys/net/core/wmem_default", "65536"),
         Status.WARNING, "sysctl -w net.core.wmem_default=212992"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_with_the_command_that_mends_it(
    pi: PiTree, look: Look, check: Check, change: Change, status: Status, mend: str | None
) -> None:
    pi.write(*change)
    finding = verdict(pi.machine(), look, check)
    assert finding.status == status
    assert finding.mend is None if mend is None else mend in str(finding.mend)
    assert (finding.topic is None) == (status == Status.SKIPPED), "every trouble has an entry in the page"


def test_a_root_that_is_read_only_on_purpose_is_in_order(pi: PiTree) -> None:
    pi.write("/proc/mounts", "rootfs / rootfs rw 0 0\noverlay / overlay ro,relatime 0 0")
    pi.write("/etc/fstab", "# / comment none ro\n/dev/mmcblk0p2 / ext4 defaults,ro 0 1")
    assert verdict(pi.machine(), disk, Check.WRITABLE).status == Status.OK


@pytest.mark.parametrize(
    ("free", "status"), [(5 << 30, Status.OK), (100 << 20, Status.WARNING), (1 << 20, Status.FAILED)]
)
def test_the_fullest_file_system_counts(pi: PiTree, free: int, status: Status) -> None:
    machine = pi.machine(free_bytes=lambda folder: free if folder.name == "log" else 20 << 30)
    finding = verdict(machine, disk, Check.SPACE)
    assert finding.status == status
    assert status == Status.OK or "/var/log" in finding.text


def test_an_undisciplined_clock_is_a_warning_that_names_what_is_missing(pi: PiTree) -> None:
    """chrony that runs needs `rtcsync`; where nothing runs, chrony is missing, with the server as source."""
    free_running = pi.machine(kernel_clock=lambda: KernelClock(False, 16_000_000, 16_000_000))
    assert "rtcsync" in str(verdict(free_running, clock, Check.CLOCK_SYNCHRONISED).mend)
    pi.remove("/run/chrony/chronyd.pid")
    finding = verdict(free_running, clock, Check.CLOCK_SYNCHRONISED)
    assert finding.status == Status.WARNING
    assert "server 10.0.0.1 iburst" in str(finding.mend)


def test_the_interface_is_the_one_that_leads_to_the_server(pi: PiTree) -> None:
    """10.0.0.0/24 is at eth0; all else goes by the wireless default route."""
    assert "eth0" in verdict(pi.machine(), network, Check.LINK_SPEED).text
    elsewhere = AgentSettings(server="192.0.2.7")
    finding = verdict(pi.machine(), network, Check.LINK_SPEED, elsewhere)
    assert (finding.status, "wlan0 is wireless" in finding.text) == (Status.WARNING, True)


def test_a_server_name_that_nobody_knows_fails(pi: PiTree, monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: Any, **__: Any) -> Any:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    settings = AgentSettings(server="no-such-rig.invalid")
    finding = verdict(pi.machine(), network, Check.SERVER_NAME, settings)
    assert finding.status == Status.FAILED
    assert "no-such-rig.invalid" in finding.text


def test_libraries_that_are_missing_name_their_package(pi: PiTree) -> None:
    def absent_driver(*_: Any) -> Any:
        raise ConfigurationError("libfreenect cannot be loaded")

    machine = pi.machine(load_libfreenect=absent_driver)
    found = {finding.check: finding for finding in libraries(machine, SETTINGS)}
    assert found[Check.LIBUSB].mend == "sudo apt install libusb-1.0-0"
    assert found[Check.LIBFREENECT].mend == "sudo apt install libfreenect0.5"
    assert found[Check.PYTHON].status == Status.OK
    assert {found[Check.LIBUSB].status, found[Check.LIBFREENECT].status} == {Status.FAILED}


def test_a_source_without_usb_needs_no_usb_library(pi: PiTree) -> None:
    found = libraries(pi.machine(), AgentSettings(source="synthetic"))
    assert [finding.check for finding in found] == [Check.PYTHON]


def test_a_program_that_runs_is_seen_and_a_doctor_is_not(pi: PiTree) -> None:
    pi.write("/proc/77/cmdline", "sudo\0rig-agent\0--check\0")
    assert not pi.machine().runs("rig-agent")
    pi.write("/proc/78/cmdline", "/opt/kinect-rig/bin/python3\0/opt/kinect-rig/bin/rig-agent\0--config\0x\0")
    assert pi.machine().runs("rig-agent")
