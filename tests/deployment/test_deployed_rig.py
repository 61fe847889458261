"""Rules of a rig that Ansible deploys: a PC and a Pi with two Kinects, of Debian roots made by debootstrap.

`make deploy-test`; needs root, `apt install debootstrap systemd-container iproute2` and the extra `deploy`.
The tests build on one another, in this order: installed by chroot, booted, upgraded, rolled back.
"""

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from support.debian_machine import NEEDS, DebianMachine, make_base, write_enter
from support.network_namespaces import Namespaces, command

REPOSITORY = Path(__file__).resolve().parents[2]
WORK = REPOSITORY / "build" / "deploy-test"
PC_ADDRESS, PI_ADDRESS = "10.77.0.1", "10.77.0.2"
CAMERAS = ("cam00", "cam01")
UNITS = {"pc": ["rig-server.service"], "pi": [f"rig-agent@{camera}.service" for camera in CAMERAS]}
MAX_EXPOSURE = 3.0
TIMEOUT_S = 90.0

_INVENTORY = """[server]
pc {pc}
[agents]
pi {pi} kinects='[{{"slot": 0}}, {{"slot": 1}}]'
[all:vars]
rig_server_address={address}
rig_health_retries=15
{checkout}
agent_settings={{"source": "synthetic", "synthetic": {{"frames_rendered": 2, "fps": 5.0, "cameras": 2}}}}
"""


def missing() -> str | None:
    """What these tests lack here, in words; None: nothing."""
    absent = [tool for tool in NEEDS if shutil.which(tool) is None]
    if os.geteuid() != 0:
        return "deploying to Debian roots needs root"
    if absent:
        return f"{', '.join(absent)} absent: apt install debootstrap systemd-container iproute2"
    if importlib.util.find_spec("ansible_collections") is None:
        return "Ansible is absent: pip install '.[deploy]'"
    return None


pytestmark = [
    pytest.mark.deploy,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(missing() is not None, reason=missing() or ""),
]


@dataclass
class Recap:
    """What a playbook did: its exit status, what it printed, changes by machine."""

    status: int
    output: str

    @property
    def changed(self) -> dict[str, int]:
        return {host: int(n) for host, n in re.findall(r"^(\w+)\s+:.*changed=(\d+)", self.output, re.M)}


def checkout(name: str, version: str, agent_line: str = "") -> str:
    """A copy of the repository as a release, its agent with one more line; the variable that takes it."""
    copy = WORK / name
    shutil.rmtree(copy, ignore_errors=True)
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    for file in filter(None, listed.stdout.split("\0")):
        if (REPOSITORY / file).is_file() and not file.startswith(("tests/", "docs/")):
            (copy / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(REPOSITORY / file, copy / file)
    project, agent = copy / "pyproject.toml", copy / "agent/rig_agent/agent.py"
    project.write_text(re.sub(r'^version = ".*"$', f'version = "{version}"', project.read_text(), flags=re.M))
    agent.write_text(f"{agent.read_text()}\n{agent_line}\n")
    return f"rig_checkout={copy}"


class Site:
    """The PC and the Pi, and Ansible for them."""

    def __init__(self, network: Namespaces) -> None:
        WORK.mkdir(parents=True, exist_ok=True)
        make_base(WORK / "base")
        self.machines = {name: DebianMachine(WORK / "base", WORK / name) for name in UNITS}
        self._network = network
        self._enter = write_enter(WORK / "enter")
        self._checkout = checkout("first", "98.0")  # a copy: nobody edits it meanwhile

    def play(self, playbook: str, *options: str, booted: bool = False) -> Recap:
        """Run a playbook, by chroot or on the booted machines."""
        inventory = WORK / "inventory"
        ways = {name: one.connection(self._enter if booted else None) for name, one in self.machines.items()}
        inventory.write_text(_INVENTORY.format(**ways, address=PC_ADDRESS, checkout=self._checkout))
        words = [f"{Path(sys.executable).parent}/ansible-playbook", "-i", str(inventory), playbook, *options]
        environment = {**os.environ, "ANSIBLE_NOCOLOR": "1"}
        environment.pop("PYTHONPATH", None)
        done = subprocess.run(
            words,
            cwd=REPOSITORY / "deploy" / "ansible",
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        recap = Recap(done.returncode, done.stdout)
        with (WORK / "ansible.log").open("a") as log:
            log.write(f"# {playbook} {' '.join(options)}\n{done.stdout}\n")
        print(f"{playbook} {' '.join(options)}: status {recap.status}, changed {recap.changed}")
        return recap

    def boot(self) -> None:
        """Both machines, on one cable."""
        for name in UNITS:
            self._network.add(name)
        full = self._network.full_name
        command(f"ip link add rig0 netns {full('pc')} type veth peer name rig0 netns {full('pi')}")
        for name, address in (("pc", PC_ADDRESS), ("pi", PI_ADDRESS)):
            self._network.command(name, f"ip addr add {address}/24 dev rig0")
            self._network.command(name, "ip link set rig0 up")
            self.machines[name].boot(full(name))

    def metric(self, name: str) -> float:
        """One figure of the running server; 0 where it does not tell it (yet)."""
        script = "from urllib.request import urlopen as u; print(u('http://127.0.0.1:9100/metrics').read().decode())"
        page = self.machines["pc"].run("python3", "-c", script, check=False)
        found = re.search(rf"^{re.escape(name)} (\S+)$", page, re.M)
        return float(found.group(1)) if found else 0.0

    def release(self, machine: str) -> str:
        """What runs there."""
        return str((self.machines[machine].root / "opt/kinect-rig/current").readlink())


@pytest.fixture(scope="module")
def site() -> Iterator[Site]:
    network = Namespaces()
    made = Site(network)
    try:
        yield made
    finally:
        for machine in made.machines.values():
            machine.power_off()
        network.remove()


def wait_until(holds: Callable[[], bool], what: str) -> None:
    until_s = time.monotonic() + TIMEOUT_S
    while not holds():
        assert time.monotonic() < until_s, f"not within {TIMEOUT_S:.0f} s: {what}"
        time.sleep(0.5)


def complete_sets(site: Site) -> float:
    return site.metric('rig_sets_total{outcome="complete"}')


def wait_for_sets(site: Site, count: int = 20) -> None:
    before = complete_sets(site)
    wait_until(lambda: complete_sets(site) >= before + count, f"{count} more complete sets")


def test_the_first_run_installs_and_the_second_changes_nothing(site: Site) -> None:
    first = site.play("site.yml")
    assert first.status == 0, first.output
    assert all(first.changed.values())
    second = site.play("site.yml")
    assert second.status == 0, second.output
    assert second.changed == {"pc": 0, "pi": 0}, second.output


def test_the_key_is_told_to_nobody(site: Site) -> None:
    files = [machine.root / "etc/kinect-rig/rig.key" for machine in site.machines.values()]
    assert len({file.read_text() for file in files}) == 1
    assert {file.stat().st_mode & 0o777 for file in files} == {0o600}
    secret = files[0].read_text().split()[-1]
    assert secret not in (WORK / "ansible.log").read_text()


def test_systemd_finds_nothing_wrong_with_the_units_where_they_are_installed(site: Site) -> None:
    for name, machine in site.machines.items():
        for unit in UNITS[name]:
            assert machine.run("systemd-analyze", "verify", unit) == ""


def test_every_service_is_exposed_little(site: Site) -> None:
    for name, machine in site.machines.items():
        for unit in UNITS[name]:
            said = machine.run("systemd-analyze", "security", "--offline=true", "--no-pager", unit)
            exposure = re.search(rf"exposure level for {re.escape(unit)}: ([\d.]+)", said)
            assert exposure is not None, said
            print(f"{unit}: exposure {exposure.group(1)}")
            assert float(exposure.group(1)) <= MAX_EXPOSURE


def test_booted_machines_stream_and_need_no_further_change(site: Site) -> None:
    site.boot()
    wait_for_sets(site)
    print(f"complete sets: {complete_sets(site):.0f}")
    third = site.play("site.yml", booted=True)
    assert third.status == 0, third.output
    assert third.changed == {"pc": 0, "pi": 0}, third.output


@pytest.mark.parametrize("source", ["synthetic", "freenect"])
def test_the_doctor_finds_nothing_wrong_but_the_hardware(site: Site, source: str) -> None:
    words = ["runuser", "--user=kinect-rig", "--", "env", f"RIG_AGENT_SOURCE={source}"]
    words += [
        "/opt/kinect-rig/current/bin/rig-agent",
        "--config",
        "/etc/kinect-rig/cam00.toml",
        "--check",
        "--json",
    ]
    said = site.machines["pi"].run(*words, check=False)
    report = json.loads(said)
    lines = [f"{one['status']} {one['name']}: {one['message']}" for one in report["checks"]]
    print("\n".join(lines))
    assert report["passed_but_for_hardware"], said


def test_a_running_service_may_ask_how_good_the_clock_is(site: Site) -> None:
    for name, machine in site.machines.items():
        for unit in UNITS[name]:
            allowed = machine.run("systemctl", "show", "--property=SystemCallFilter", unit)
            assert {"adjtimex", "clock_adjtime"} <= set(allowed.partition("=")[2].split())
            assert "clock_settime" not in allowed


def test_the_journal_says_which_camera_speaks(site: Site) -> None:
    for camera in CAMERAS:
        lines = site.machines["pi"].run("journalctl", "--no-pager", f"KINECT_RIG_CAMERA={camera}")
        assert f"rig-agent@{camera}[" in lines
        assert "connected to" in lines


def test_a_frame_loop_that_stops_is_ended_and_started_again_by_systemd(site: Site) -> None:
    pc = site.machines["pc"]
    pc.run("systemctl", "kill", "--signal=STOP", "rig-server.service")
    wait_until(
        lambda: "NRestarts=1" in pc.run("systemctl", "show", "-p", "NRestarts", "rig-server.service"),
        "a restart by the watchdog",
    )
    assert "Watchdog timeout" in pc.run("journalctl", "--no-pager", "-u", "rig-server.service")
    wait_for_sets(site)


def test_an_upgrade_goes_from_machine_to_machine_and_back_again(site: Site) -> None:
    before = {name: site.release(name) for name in UNITS}
    option = checkout("next", "99.0")
    preview = site.play("site.yml", "-e", option, "--check", booted=True)
    assert preview.status == 0, preview.output
    assert {name: site.release(name) for name in UNITS} == before
    assert site.play("upgrade.yml", "-e", option, "--tags", "install").status == 0
    upgrade = site.play("upgrade.yml", "-e", option, booted=True)
    assert upgrade.status == 0, upgrade.output
    assert all(site.release(name).startswith("releases/99.0-") for name in UNITS)
    wait_for_sets(site)
    assert site.play("upgrade.yml", "-e", option, booted=True).changed == {"pc": 0, "pi": 0}
    rollback = site.play("rollback.yml", booted=True)
    assert rollback.status == 0, rollback.output
    assert {name: site.release(name) for name in UNITS} == before
    wait_for_sets(site)


def test_a_machine_that_is_not_healthy_goes_back_to_its_release_of_before(site: Site) -> None:
    before = site.release("pi")
    option = checkout("broken", "99.1", "Agent.run = lambda self: self._service_manager.notify('READY=1')")
    assert site.play("upgrade.yml", "-e", option, "--limit", "pi", "--tags", "install").status == 0
    upgrade = site.play("upgrade.yml", "-e", option, "--limit", "pi", booted=True)
    assert upgrade.status != 0
    assert "was not healthy with 99.1-" in " ".join(upgrade.output.split())
    assert site.release("pi") == before
    wait_for_sets(site)
