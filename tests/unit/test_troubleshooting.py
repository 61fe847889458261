"""Rules of the troubleshooting page: errors lead to entries that exist, entries name what exists."""

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer

import rig_agent.cli
import rig_calib.cli
import rig_server.cli
from rig_agent.config import AgentSettings
from rig_agent.doctor.finding import Check
from rig_protocol import errors
from rig_protocol.troubleshooting import Topic, reference
from rig_server.config import RigSettings

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGE = (DOCS / "troubleshooting.md").read_text()
APPS = {"rig-agent": rig_agent.cli.app, "rig-server": rig_server.cli.app, "rig-calib": rig_calib.cli.app}
SOURCES = [
    path for room in ("protocol", "agent", "server", "calib") for path in sorted((ROOT / room).rglob("*.py"))
]


def anchor(heading: str) -> str:
    """As the page's readers make it: lower case, hyphens for spaces, nothing but letters and digits else."""
    return re.sub(r"[^a-z0-9-]", "", heading.lower().replace(" ", "-"))


def entries() -> dict[str, str]:
    parts = re.split(r"^## (.+)$", PAGE, flags=re.M)[1:]
    return dict(zip(map(anchor, parts[::2]), parts[1::2], strict=True))


def code(text: str) -> list[str]:
    """What stands in backticks and in blocks of code."""
    blocks = re.findall(r"```\n(.*?)```", text, re.S)
    lines = [line.partition(" #")[0].strip() for block in blocks for line in block.splitlines()]
    return lines + re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.S))


def test_every_topic_of_an_error_has_its_entry_and_every_entry_its_topic() -> None:
    assert list(entries()) == [topic.value for topic in Topic]


def test_the_reference_is_the_path_of_the_page() -> None:
    path, _, name = reference(Topic.NO_KINECT).removeprefix("see ").partition("#")
    assert (ROOT / path).read_text() == PAGE
    assert name in entries()


def test_anchors_are_written_in_one_place() -> None:
    """A second place could name an entry that is not there."""
    named = [path.name for path in SOURCES if "troubleshooting.md" in path.read_text()]
    assert set(named) == {"troubleshooting.py"}


def test_every_kind_of_error_has_a_topic() -> None:
    kinds = [errors.RigError, *errors.RigError.__subclasses__()]
    assert all(isinstance(kind("told").topic, Topic) for kind in kinds)
    assert errors.DataError("told", Topic.FULL_DISK).topic == Topic.FULL_DISK


@pytest.mark.parametrize("name", entries())
def test_an_entry_says_where_it_shows(name: str) -> None:
    """By a counter of the server, a check of the doctor, a quoted message, a file or an exit status."""
    shows = re.search(r"^Shows in: (.+?)\n\n", entries()[name], re.M | re.S)
    assert shows is not None
    checks = {check.value for check in Check}
    said = set(code(shows[1]))
    assert said & checks or "rig_" in shows[1] or '"' in shows[1] or "exit status" in shows[1]


def test_the_counters_are_documented_ones() -> None:
    documented = set(re.findall(r"^\| `(rig_\w+)`", (DOCS / "monitoring.md").read_text(), re.M))
    named = {name for span in code(PAGE) for name in re.findall(r"\brig_[a-z_]+[a-z]", span)}
    assert named
    assert named <= documented


def test_the_checks_are_the_doctors() -> None:
    rooms = {check.value.partition(".")[0] for check in Check if "." in check.value}
    named = {span for span in code(PAGE) if re.fullmatch(rf"({'|'.join(rooms)})\.[a-z0-9_]+", span)}
    known = {check.value for check in Check}
    assert named - settings_keys(AgentSettings) - settings_keys(RigSettings) <= known
    assert known - set(code(PAGE)) == set(), "a check that no entry names"


def settings_keys(model: type) -> set[str]:
    fields = getattr(model, "model_fields", {})
    keys = set(fields)
    for name, field in fields.items():
        if isinstance(field.annotation, type):
            keys |= {f"{name}.{key}" for key in settings_keys(field.annotation)}
    return keys


def test_the_settings_are_known() -> None:
    known = settings_keys(AgentSettings) | settings_keys(RigSettings)
    tables = {key.partition(".")[0] for key in known if "." in key}
    named = {span.partition(" ")[0] for span in code(PAGE) if span.partition(".")[0] in tables}
    assert {"freenect.serial", "pacing.spread", "synchroniser.deadline_ms", "link.adapt"} <= named
    assert named - {"calibration.json"} <= known


def test_the_commands_are_ours_with_options_that_there_are() -> None:
    spans = [re.sub(r"^sudo -u \S+ ", "", span) for span in code(PAGE)]
    lines = [span for span in spans if span.partition(" ")[0].rpartition("/")[2] in APPS]
    assert len(lines) > 8
    for line in lines:
        program, *words = shlex.split(line)
        command: Any = typer.main.get_command(APPS[program.rpartition("/")[2]])
        if words and not words[0].startswith("-"):
            command = command.commands[words[0]]
        known = {option for parameter in command.params for option in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= known, line


def test_the_messages_are_those_of_the_code() -> None:
    """A reader looks for what the log said; each quotation stands in one string of the source."""
    text = "\n".join(path.read_text() for path in SOURCES)
    joined = re.sub(r'"\s*\n\s*f?"', "", text)
    quoted = re.findall(r'"([^"\n]+)"', re.sub(r"```.*?```|`[^`]*`", "", PAGE, flags=re.S))
    of_the_kernel = {"Network is unreachable"}
    assert len(quoted) > 20
    assert [words for words in quoted if words not in joined and words not in of_the_kernel] == []


def test_the_links_lead_somewhere() -> None:
    for target in re.findall(r"\]\(([^)]+)\)", PAGE):
        file, _, name = target.partition("#")
        page = (DOCS / file).read_text() if file else PAGE
        headings = map(anchor, re.findall(r"^#+ (.+)$", page, re.M))
        assert not name or name in set(headings), target
