"""Rules of the command line: root flags override the file, wrong usage ends with status 2."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig_agent import cli
from rig_agent.config import AgentSettings, load_agent_settings
from rig_protocol.errors import ConfigurationError
from rig_protocol.key_file import write_key
from rig_protocol.rig_key import RigKey


@pytest.fixture(autouse=True)
def _nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("rig_agent.config.CONFIG_PLACES", (Path("agent.toml"),))
    monkeypatch.setattr(cli, "_on_signals", lambda _action: None)  # the signals are pytest's


@pytest.fixture
def streamed(monkeypatch: pytest.MonkeyPatch) -> list[AgentSettings]:
    """What would have been streamed."""
    found: list[AgentSettings] = []
    monkeypatch.setattr(cli, "_stream", found.append)
    return found


def invoke(*words: str) -> str:
    result = CliRunner().invoke(cli.app, words)
    if result.exception is not None:
        raise result.exception
    return result.output


def test_flags_override_the_file(streamed: list[AgentSettings]) -> None:
    Path("agent.toml").write_text('server = "file"\nfps = 5.0\nsource = "synthetic"\n')
    invoke("--server", "pc:1", "--camera", "4", "--seed", "9", "--cameras", "6")
    (settings,) = streamed
    assert (settings.server, settings.fps, settings.camera) == ("pc:1", 5.0, 4)
    assert (settings.synthetic.seed, settings.synthetic.cameras) == (9, 6)


def test_the_key_is_named_or_gone_without(streamed: list[AgentSettings]) -> None:
    invoke("--source", "synthetic", "--key-file", "my.key")
    invoke("--source", "synthetic", "--insecure")
    invoke("--source", "synthetic")
    assert [(settings.key_file, settings.insecure) for settings in streamed] == [
        (Path("my.key"), False),
        (None, True),
        (None, False),
    ]


def test_an_agent_without_a_key_ends_with_status_2_and_is_told_how_to_get_one(tmp_path: Path) -> None:
    key = tmp_path / "rig.key"
    key.write_text("not a key")
    key.chmod(0o644)
    words = ["--source", "synthetic", "--camera", "0", "--key-file", str(key)]
    done = subprocess.run(
        [sys.executable, "-m", "rig_agent.cli", *words], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2
    assert f"chmod 600 {key}" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_folders_camera_may_be_named(streamed: list[AgentSettings]) -> None:
    invoke("--source", "folder", "--path", "rig", "--camera", "left")
    (settings,) = streamed
    assert (settings.camera, settings.folder.camera, settings.folder.path) == (None, "left", Path("rig"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--truth-out", "t.json"), r"--truth-out belongs to --source synthetic, but the source is freenect"),
        (("--source", "folder", "--seed", "1"), r"--seed belongs to --source synthetic"),
        (("--recording", "a.oni"), r"--recording belongs to --source openni2"),
        (("--path", "rig"), r"--path belongs to --source folder"),
        (("--camera", "left"), r"--camera NAME belongs to --source folder"),
        (
            ("--source", "kinect"),
            r"`source`: Input should be 'freenect', .*'recording' or 'synthetic'",
        ),
    ],
)
def test_an_option_that_would_be_ignored_is_refused(words: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        invoke(*words)


def test_print_config_prints_what_loads_again(tmp_path: Path) -> None:
    printed = invoke("--source", "folder", "--path", "rig", "--camera", "2", "--print-config")
    (tmp_path / "printed.toml").write_text(printed)
    settings = load_agent_settings(tmp_path / "printed.toml")
    assert (settings.source, settings.camera, settings.folder.path) == ("folder", 2, Path("rig"))


def test_the_truth_is_written_before_streaming(streamed: list[AgentSettings]) -> None:
    invoke("--source", "synthetic", "--cameras", "3", "--truth-out", "truth.json")
    assert [camera["id"] for camera in json.loads(Path("truth.json").read_text())["cameras"]] == [0, 1, 2]
    assert len(streamed) == 1


def test_init_writes_a_file_that_changes_nothing_and_overwrites_only_by_force() -> None:
    invoke("init")
    assert load_agent_settings(None) == AgentSettings()
    Path("agent.toml").write_text('server = "mine"\n')
    with pytest.raises(ConfigurationError, match=r"agent.toml exists: --force"):
        invoke("init")
    assert load_agent_settings(None).server == "mine"
    invoke("init", "--force")
    assert load_agent_settings(None) == AgentSettings()


def test_help_teaches_by_examples() -> None:
    text = invoke("--help")
    assert "rig-agent init" in text
    assert "RIG_AGENT_SERVER" in text


def test_a_mistake_ends_the_program_with_status_2_and_one_message() -> None:
    Path("agent.toml").write_text('sever = "pc"\n')
    done = subprocess.run([sys.executable, "-m", "rig_agent.cli"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert "did you mean `server`?" in done.stderr
    assert "Traceback" not in done.stderr


def test_the_agent_imports_no_calibration_code_and_none_of_its_libraries() -> None:
    modules = "rig_agent.cli, rig_agent.agent, rig_agent.sources.folder, rig_agent.sources.synthetic"
    code = f"import sys, {modules}; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    roots = {name.partition(".")[0] for name in done.stdout.split()}
    assert not roots & {"rig_calib", "rig_server", "scipy", "numba", "matplotlib"}
    assert "rig_agent" in roots


def test_a_take_is_named_on_the_command_line(streamed: list[AgentSettings]) -> None:
    invoke("--source", "synthetic", "--camera", "3", "--record", "take.mcap", "--server", "none")
    (settings,) = streamed
    assert (settings.record.path, settings.server, settings.address) == (Path("take.mcap"), "none", None)


def test_who_records_needs_neither_server_nor_key_but_a_named_server_needs_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rig_protocol.key_file.KEY_PLACES", (tmp_path / "rig.key",))
    record = {"path": tmp_path}
    for server in ("none", "auto"):
        alone = AgentSettings.model_validate({"server": server, "record": record})
        assert cli._key(alone) is None
    for needing in ({"server": "pc", "record": record}, {"server": "auto"}):
        with pytest.raises(ConfigurationError, match="this rig has no key"):
            cli._key(AgentSettings.model_validate(needing))
    write_key(tmp_path / "rig.key", key := RigKey(bytes(range(32))))
    assert cli._key(AgentSettings.model_validate({"server": "auto", "record": record})) == key
