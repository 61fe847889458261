"""Rules of the files that are installed on the Pis and the PC. `make deploy-test` installs them for real."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jinja2
import pytest
import yaml

from rig_agent.config import AgentSettings
from rig_server.config import RigSettings

REPOSITORY = Path(__file__).resolve().parents[2]
DEPLOY = REPOSITORY / "deploy"
ANSIBLE = DEPLOY / "ansible"
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
PLAYBOOKS = sorted(ANSIBLE.glob("*.yml"))
TASK_FILES = sorted([*ANSIBLE.glob("roles/*/tasks/*.yml"), *ANSIBLE.glob("roles/*/handlers/*.yml")])
KINECT_PRODUCTS = {"02ae", "02bf", "02b0", "02c2", "02ad", "02be", "02c3", "02bb"}
MAX_EXPOSURE = 3.0
BESIDES_MODULES = {
    *("name", "tags", "vars", "when", "loop", "loop_control", "register", "notify", "delegate_to", "become"),
    *("run_once", "check_mode", "changed_when", "failed_when", "no_log", "retries", "delay", "until"),
    *("block", "rescue"),
}


def tool(name: str, package: str) -> str:
    """The program; beside this Python first. Skips where it is absent."""
    beside = Path(sys.executable).with_name(name)
    found = str(beside) if beside.exists() else shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is absent: {package}")
    return found


def said(*words: str | Path, cwd: Path = REPOSITORY) -> str:
    done = subprocess.run([str(word) for word in words], cwd=cwd, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


def key(unit: Path, name: str) -> list[str]:
    return re.findall(rf"^{name}=(.*)$", unit.read_text(), re.M)


# ---- services


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_systemd_finds_nothing_wrong_but_the_absent_program(unit: Path) -> None:
    analyze = tool("systemd-analyze", "apt install systemd")
    absent = r"rig-\S+: Command /opt/kinect-rig/current/bin/\S+ is not executable: No such file or directory"
    complaints = [
        line for line in said(analyze, "verify", unit).splitlines() if not re.fullmatch(absent, line)
    ]
    assert complaints == []


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_a_service_that_is_taken_over_can_do_little(unit: Path) -> None:
    analyze = tool("systemd-analyze", "apt install systemd")
    found = re.search(r"exposure level for \S+ ([\d.]+)", said(analyze, "security", "--offline=true", unit))
    assert found is not None
    assert float(found.group(1)) <= MAX_EXPOSURE


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_a_service_may_ask_how_good_the_clock_is(unit: Path) -> None:
    """ProtectClock= and @privileged forbid adjtimex; the rig would quietly stop using disciplined clocks."""
    assert key(unit, "ProtectClock") == []
    assert key(unit, "SystemCallFilter")[-1] == "adjtimex clock_adjtime"


def test_the_units_run_the_installed_programs_with_their_configuration() -> None:
    assert {unit.name: key(unit, "ExecStart") for unit in UNITS} == {
        "rig-agent@.service": ["/opt/kinect-rig/current/bin/rig-agent --config /etc/kinect-rig/%i.toml"],
        "rig-server.service": ["/opt/kinect-rig/current/bin/rig-server --config /etc/kinect-rig/rig.toml"],
    }


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_a_service_that_keeps_failing_is_started_again_for_ever(unit: Path) -> None:
    assert key(unit, "Restart") == ["always"]
    assert key(unit, "StartLimitIntervalSec") == ["0"]


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_systemd_watches_over_a_service_which_reports_to_it(unit: Path) -> None:
    """Both programs send READY=1 and WATCHDOG=1; a driver that hangs has a minute from the agent, too."""
    assert key(unit, "Type") == ["notify"]
    assert 10 <= int(key(unit, "WatchdogSec")[0]) <= 60


def test_the_units_use_no_word_that_the_oldest_systemd_does_not_know() -> None:
    """Debian 12 has 252; what only newer ones know stands in a drop-in that is installed where they are."""
    assert not any("RestartSteps" in unit.read_text() for unit in UNITS)
    assert "RestartSteps=" in (DEPLOY / "systemd" / "backoff.conf").read_text()


# ---- USB and network


def test_the_udev_rules_cover_every_kinect_product() -> None:
    rules = (DEPLOY / "udev" / "60-kinect-rig.rules").read_text()
    listed = re.search(r'ATTR\{idProduct\}!="([0-9a-f|]+)"', rules)
    assert listed is not None
    assert set(listed.group(1).split("|")) == KINECT_PRODUCTS
    assert 'ATTR{idVendor}!="045e"' in rules


def test_the_receive_buffer_limit_is_what_the_server_asks_for() -> None:
    """212,992 bytes lose datagrams at 900 Mbit/s, 2 MiB do not; the server has no capability to get more."""
    limits = (DEPLOY / "sysctl" / "60-kinect-rig.conf").read_text()
    limit = re.search(r"^net\.core\.rmem_max = (\d+)$", limits, re.M)
    assert limit is not None
    assert int(limit.group(1)) >= RigSettings().receive_buffer_bytes >= 2 * 1024 * 1024
    assert "\nnet.core.default_qdisc = fq\n" in limits


def test_both_clocks_tell_the_kernel_how_good_they_are() -> None:
    """Without `rtcsync` chrony does not, and they are not used; no Pi follows another clock than the PC's."""
    texts = {name: (DEPLOY / "chrony" / f"{name}.conf").read_text() for name in ("server", "agent")}
    assert all("\nrtcsync\n" in text for text in texts.values())
    assert re.search(r"^(pool|server|confdir)", texts["agent"], re.M) is None


# ---- Ansible


def tasks(content: Any) -> Iterator[Mapping[str, Any]]:
    """All tasks of a file, those in blocks too."""
    for task in content or ():
        yield task
        for section in ("block", "rescue", "tasks"):
            yield from tasks(task.get(section))


@pytest.mark.parametrize("file", TASK_FILES, ids=lambda file: str(file.relative_to(ANSIBLE)))
def test_tasks_need_no_collection(file: Path) -> None:
    """ansible-core alone deploys a rig."""
    for task in tasks(yaml.safe_load(file.read_text())):
        modules = [word for word in task if word not in BESIDES_MODULES]
        assert all(module.startswith("ansible.builtin.") for module in modules), (task["name"], modules)


@pytest.mark.parametrize("file", TASK_FILES, ids=lambda file: str(file.relative_to(ANSIBLE)))
def test_tasks_that_touch_the_key_say_nothing_in_logs(file: Path) -> None:
    touching = ("slurp", "keygen", "b64decode")
    for task in tasks(yaml.safe_load(file.read_text())):
        if "block" not in task and any(word in json.dumps(task) for word in touching):
            assert task.get("no_log") is True, task["name"]


def test_every_file_that_a_task_installs_is_there() -> None:
    text = "".join(file.read_text() for file in TASK_FILES)
    named = re.findall(r'"\{\{ rig_deploy \}\}/([^"{]+)"', text)
    assert len(named) >= 6
    assert [name for name in named if not (DEPLOY / name).is_file()] == []
    units = re.findall(r"rig_unit_file: (\S+)", text)
    assert sorted(units) == [unit.name for unit in UNITS]


def rendered(settings: Mapping[str, Any], cameras: list[Mapping[str, Any]] | None = None) -> dict[str, Any]:
    """What settings.toml.j2 makes of them, read as TOML."""
    environment = jinja2.Environment(trim_blocks=True, autoescape=False)  # noqa: S701  # TOML, as Ansible does
    environment.filters["to_json"] = json.dumps
    template = environment.from_string((ANSIBLE / "roles/rig/templates/settings.toml.j2").read_text())
    return tomllib.loads(template.render(rig_settings=settings, rig_settings_cameras=cameras or []))


def test_settings_of_the_inventory_arrive_in_the_agent() -> None:
    settings = {
        "freenect": {"port_path": "1-1"},
        "server": "rig-pc.local:4012",
        "camera": 7,
        "name": "cam07",
        "synthetic": {"fps": 5.0, "room_m": [4, 5, 2.6], "patterns": True},
    }
    agent = AgentSettings.model_validate(rendered(settings))
    assert (agent.camera, agent.freenect.port_path, agent.synthetic.fps) == (7, "1-1", 5.0)


def test_settings_of_the_inventory_arrive_in_the_server() -> None:
    cameras = [{"id": k, "name": f"cam{k:02d}"} for k in range(12)]
    rig = RigSettings.model_validate(rendered({"metrics": "9100", "ring": {"radius_m": 0.3}}, cameras))
    assert [camera.label for camera in rig.cameras] == [f"cam{k:02d}" for k in range(12)]
    assert rig.ring is not None
    assert rig.ring.radius_m == 0.3


def test_the_example_inventory_lists_twelve_pis_and_a_pc() -> None:
    inventory = tool("ansible-inventory", "pip install '.[deploy]'")
    listed = json.loads(said(inventory, "-i", ANSIBLE / "example.inventory", "--list", cwd=ANSIBLE))
    assert listed["server"]["hosts"] == ["rig-pc.local"]
    assert listed["agents"]["hosts"] == [f"cam{k:02d}.local" for k in range(12)]


def evaluated(inventory: Path, expression: str) -> Any:
    ansible = tool("ansible", "pip install '.[deploy]'")
    words = ("-i", inventory, "agents", "--limit", "big-pc", "-c", "local", "-m", "ansible.builtin.debug")
    variables = ANSIBLE / "roles/rig/vars/main.yml"
    answer = said(ansible, *words, "-a", f"var={expression}", "-e", f"@{variables}", cwd=ANSIBLE)
    found = (
        re.search(r"(\{.*\})", answer, re.S) if "=> {" in answer else re.search(r"=>\s*\n(.*)", answer, re.S)
    )
    assert found is not None, answer
    return yaml.safe_load(found.group(1))[expression]


def test_the_slot_is_in_the_machines_name_unless_the_inventory_says_it(tmp_path: Path) -> None:
    inventory = tmp_path / "rig.inventory"
    kinects = '[{"slot": 8, "port_path": "1-1"}, {"slot": 9, "serial": "A0", "name": "door"}]'
    lines = [
        "[agents]",
        "cam07.local",
        "attic slot=3",
        f"big-pc kinects='{kinects}'",
        "10.0.0.4",
        "[server]",
        "pc",
    ]
    inventory.write_text("\n".join(lines))
    cameras = evaluated(inventory, "rig_cameras")
    assert [(camera["host"], camera["slot"], camera["name"]) for camera in cameras] == [
        ("cam07.local", 7, "cam07"),
        ("attic", 3, "cam03"),
        ("big-pc", 8, "cam08"),
        ("big-pc", 9, "door"),
        ("10.0.0.4", -1, "cam-1"),  # refused by requirements.yml
    ]
    assert [camera["which"] for camera in cameras[2:4]] == [{"port_path": "1-1"}, {"serial": "A0"}]


@pytest.mark.parametrize("playbook", PLAYBOOKS, ids=lambda file: file.name)
def test_ansible_understands_the_playbooks(playbook: Path) -> None:
    program = tool("ansible-playbook", "pip install '.[deploy]'")
    answer = said(program, "-i", "example.inventory", "--syntax-check", playbook.name, cwd=ANSIBLE)
    assert answer.split() == ["playbook:", playbook.name]


def test_yamllint_has_no_complaint() -> None:
    assert said(tool("yamllint", "pip install '.[deploy]'"), "--strict", "deploy") == ""


def test_ansible_lint_has_no_complaint() -> None:
    program = tool("ansible-lint", "pip install '.[deploy]'")
    environment = {**os.environ, "PATH": f"{Path(program).parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        [program, "--offline", "--nocolor"],
        cwd=ANSIBLE,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


# ---- other ways


def test_the_first_boot_of_a_pi_lets_ansible_in_by_key_alone() -> None:
    text = (DEPLOY / "cloud-init" / "user-data").read_text()
    assert text.startswith("#cloud-config\n")
    first_boot = yaml.safe_load(text)
    (user,) = first_boot["users"]
    assert user["lock_passwd"] is True
    assert first_boot["ssh_pwauth"] is False
    assert "python3" in first_boot["packages"]


def test_the_container_holds_what_it_copies_and_runs_as_nobody_special() -> None:
    text = (DEPLOY / "container" / "Containerfile").read_text()
    copied = [word for line in re.findall(r"^COPY (?!--)(.+) \S+$", text, re.M) for word in line.split()]
    assert [word for word in copied if not (REPOSITORY / word).exists()] == []
    assert re.findall(r"^USER (.+)$", text, re.M) == ["kinect-rig"]
    assert 'ENTRYPOINT ["rig-server"]' in text
