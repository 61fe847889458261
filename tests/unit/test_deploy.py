"""Rules of the files that are installed on the Pis and the PC."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
KINECT_PRODUCTS = {"02ae", "02bf", "02b0", "02c2", "02ad", "02be", "02c3", "02bb"}


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_systemd_finds_nothing_wrong_but_the_absent_program(unit: Path) -> None:
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("systemd-analyze is absent: apt install systemd")
    done = subprocess.run([analyze, "verify", str(unit)], capture_output=True, text=True, check=False)
    complaints = [
        line
        for line in (done.stdout + done.stderr).splitlines()
        if not re.fullmatch(
            rf"{unit.name}: Command /opt/kinect-rig/bin/\S+ is not executable: No such file or directory",
            line,
        )
    ]
    assert complaints == []


def test_the_units_run_the_installed_programs_with_their_configuration() -> None:
    commands = {unit.name: re.search(r"^ExecStart=(.+)$", unit.read_text(), re.M) for unit in UNITS}
    assert {name: match.group(1) for name, match in commands.items() if match} == {
        "rig-agent.service": "/opt/kinect-rig/bin/rig-agent --config /etc/kinect-rig/agent.toml",
        "rig-server.service": "/opt/kinect-rig/bin/rig-server --config /etc/kinect-rig/rig.toml",
    }


def test_a_service_that_keeps_failing_is_started_again_for_ever() -> None:
    for unit in UNITS:
        text = unit.read_text()
        assert "\nRestart=always\n" in text
        assert "\nStartLimitIntervalSec=0\n" in text


def test_systemd_watches_over_the_agent_which_reports_to_it() -> None:
    """The agent sends READY=1 and WATCHDOG=1; its own limit for a driver that hangs is a minute, too."""
    text = (DEPLOY / "systemd" / "rig-agent.service").read_text()
    assert "\nType=notify\n" in text
    assert "\nWatchdogSec=60\n" in text


def test_the_udev_rules_cover_every_kinect_product() -> None:
    rules = (DEPLOY / "udev" / "60-kinect-rig.rules").read_text()
    listed = re.search(r'ATTR\{idProduct\}!="([0-9a-f|]+)"', rules)
    assert listed is not None
    assert set(listed.group(1).split("|")) == KINECT_PRODUCTS
    assert 'ATTR{idVendor}!="045e"' in rules


def test_the_receive_buffer_limit_is_above_what_was_lost() -> None:
    """212,992 bytes lose datagrams at 900 Mbit/s, 2 MiB do not."""
    limit = re.search(
        r"^net\.core\.rmem_max = (\d+)$", (DEPLOY / "sysctl" / "60-kinect-rig.conf").read_text(), re.M
    )
    assert limit is not None
    assert int(limit.group(1)) >= 2 * 1024 * 1024
